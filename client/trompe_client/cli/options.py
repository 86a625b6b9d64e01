"""Kinds of options: listed by section in ``--help``, or labels."""

from collections.abc import Callable
from itertools import groupby
from typing import Any, TypeVar

import click

__all__ = ["SectionOption", "Sectioned", "tag_option"]

F = TypeVar("F", bound=Callable[..., Any])


class SectionOption(click.Option):
    """An option that ``--help`` lists in a section."""

    def __init__(self, *declarations: Any, section: str, **attributes: Any) -> None:
        super().__init__(*declarations, **attributes)
        self.section = section


class Sectioned(click.Command):
    """A command with so many options that ``--help`` lists them by section."""

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """As click's own, section by section."""
        options = (each for each in self.get_params(ctx) if isinstance(each, click.Option))
        for title, section in groupby(options, lambda option: getattr(option, "section", "Server and results")):
            with formatter.section(title):
                formatter.write_dl([record for option in section if (record := option.get_help_record(ctx))])


def tag_option(help: str) -> Callable[[F], F]:
    """--tag KEY=VALUE, a job's labels; given several times they come as one mapping, ``labels``."""
    return click.option("--tag", "labels", multiple=True, metavar="KEY=VALUE", callback=_labels, help=help)


def _labels(_ctx: click.Context, _option: click.Parameter, words: tuple[str, ...]) -> dict[str, str]:
    pairs = [word.partition("=") for word in words]
    for name, equals, value in pairs:
        if not (name and equals and value):
            raise click.BadParameter(f"{name + equals + value!r} should be a name and a value: campaign=mugs.")
    return {name: value for name, _, value in pairs}
