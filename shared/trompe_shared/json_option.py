"""The option --json of the commands of all packages."""

from collections.abc import Callable
from typing import Any, Final, TypeVar

import click

F = TypeVar("F", bound=Callable[..., Any])

_KEY: Final = "trompe.json"
"""Key of the option in click's context."""


def json_option(command: F) -> F:
    """Add --json: JSON on standard output, errors as JSON on standard error."""

    def remember(ctx: click.Context, _option: click.Parameter, given: bool) -> None:
        ctx.meta[_KEY] = given

    option = click.option("--json", is_flag=True, expose_value=False, callback=remember, help="Print JSON.")
    return option(command)


def as_json() -> bool:
    """Whether the current command has --json."""
    return bool(click.get_current_context().meta.get(_KEY))
