"""Kinds of options: listed by section in ``--help``, or labels."""

from collections.abc import Callable
from typing import Any, TypeVar

import click

F = TypeVar("F", bound=Callable[..., Any])


class SectionOption(click.Option):
    """An option in a section of ``--help``."""

    def __init__(self, *declarations: Any, section: str, **attributes: Any) -> None:
        super().__init__(*declarations, **attributes)
        self.section = section


class Sectioned(click.Command):
    """A command with its options listed by section in ``--help``."""

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """List the options section by section."""
        options = [option for option in self.get_params(ctx) if isinstance(option, click.Option)]
        sections = dict.fromkeys(option.section for option in options if isinstance(option, SectionOption))
        for title in (*sections, "Server and results"):
            with formatter.section(title):
                members = (each for each in options if getattr(each, "section", "Server and results") == title)
                formatter.write_dl([record for each in members if (record := each.get_help_record(ctx))])


def tag_option(help: str) -> Callable[[F], F]:
    """--tag KEY=VALUE, repeatable; passed on as one mapping, ``labels``."""
    return click.option("--tag", "labels", multiple=True, metavar="KEY=VALUE", callback=_labels, help=help)


def _labels(_ctx: click.Context, _option: click.Parameter, words: tuple[str, ...]) -> dict[str, str]:
    pairs = [word.partition("=") for word in words]
    for name, equals, value in pairs:
        if not (name and equals and value):
            raise click.BadParameter(f"{name + equals + value!r} should be a name and a value: campaign=mugs.")
    return {name: value for name, _, value in pairs}
