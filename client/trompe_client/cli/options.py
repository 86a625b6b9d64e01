"""Kinds of commands and options, and flags made from the options of the API."""

from collections.abc import Callable, Mapping
from typing import Any, Final, Literal, TypeVar, get_args, get_origin

import click

from trompe_shared.api import VIEW_LIMITS, Needs, Option, ViewRanges

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


LIST: Final = "list"


class ListedByDefault(click.Group):
    """A group with ``list`` as its default command."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        names = {*self.commands, *self.get_help_option_names(ctx)}
        named = ctx.resilient_parsing or (args and args[0] in names)
        return super().parse_args(ctx, args if named else [LIST, *args])

    def shell_complete(self, ctx: click.Context, incomplete: str) -> list[Any]:
        """Complete commands, and the options of ``list``."""
        options = self.commands[LIST].shell_complete(ctx, incomplete) if incomplete.startswith("-") else []
        return super().shell_complete(ctx, incomplete) + [each for each in options if each.value != "--help"]

    def format_usage(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        formatter.write_usage(ctx.command_path, "[COMMAND] [ARGS]...  (without COMMAND: list)")


def _class(word: str) -> str | int:
    return int(word) if word.isdecimal() else word


def _pair(expected: str) -> Callable[[str], tuple[str, str]]:
    """Type of NAME=VALUE; ``expected`` says what these are, with an example."""

    def parse(word: str) -> tuple[str, str]:
        name, _, value = word.partition("=")
        if not (name and value):
            raise click.BadParameter(f"{word!r} should be {expected}.")
        return name, value

    return parse


def _by_name(_ctx: click.Context, _option: click.Parameter, given: tuple[tuple[Any, ...], ...]) -> dict[str, Any]:
    return {name: values[0] if len(values) == 1 else values for name, *values in given}


def _value(kind: Any) -> Mapping[str, Any]:
    """Click's settings of a flag with values of this type."""
    if kind is bool:
        return {"is_flag": True}
    if kind is ViewRanges:
        return {"type": (click.Choice(list(VIEW_LIMITS)), float, float), "callback": _by_name}
    if get_origin(kind) is dict:
        return {"type": _pair("a texture and a picture of its size: albedo.png=mask.png"), "callback": _by_name}
    if get_origin(kind) is Literal:
        return {"type": click.Choice(get_args(kind))}
    if get_origin(kind) is tuple:
        return {"type": get_args(kind)}
    kind = get_args(kind)[0] if get_origin(kind) is list else kind
    return {"type": kind if kind in {int, float, str} else _class}


def flag_of(option: Option) -> SectionOption:
    """The flag of an option of the API."""
    words = option.help[0].upper() + option.help[1:]
    default = ", ".join(option.default) if isinstance(option.default, list) else option.default
    if type(default) in {str, int, float} and default != "":
        words += f"; default: {default}"
    unset = option.type is bool and option.default is None
    return SectionOption(
        [f"{option.flag}/--no{option.flag[1:]}" if unset else option.flag, option.keyword],
        section=option.part.title(),
        help=f"{words}.{' *' if option.repeated else ''}",
        required=option.info.is_required(),
        multiple=option.repeated,
        metavar=option.metavar,
        default=None,
        **_value(option.type),
    )


def tag_option(help: str) -> Callable[[F], F]:
    """--tag KEY=VALUE, repeatable; passed on as one mapping, ``labels``."""
    kind = _pair("a name and a value: campaign=mugs")
    return click.option("--tag", "labels", multiple=True, metavar="KEY=VALUE", type=kind, callback=_by_name, help=help)


def needs_option() -> click.Option:
    """--needs NAME=AMOUNT, repeatable; passed on as one mapping."""
    fields = ", ".join(f"{name} ({info.description})" for name, info in Needs.model_fields.items())
    words = f"What the job occupies: {fields}. Default: cpu=1. *"
    kind = _pair("a name and an amount: gpu=0.5")
    return click.Option(["--needs"], multiple=True, metavar="NAME=AMOUNT", type=kind, callback=_by_name, help=words)
