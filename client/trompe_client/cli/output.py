"""What commands say: tables for people, JSON for programs."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Final, TypeVar

import click

if TYPE_CHECKING:
    from rich.console import Console, RenderableType

__all__ = ["as_json", "console", "json_option", "print_json", "say", "show_error"]

F = TypeVar("F", bound=Callable[..., Any])
AS_JSON: Final = "trompe.json"
"""Where a context remembers that JSON was asked for."""


def json_option(command: F) -> F:
    """Give a command the option --json: one JSON document on standard output, and errors as JSON, too."""

    def remember(ctx: click.Context, _option: click.Parameter, given: bool) -> None:
        ctx.meta[AS_JSON] = given

    option = click.option("--json", is_flag=True, expose_value=False, callback=remember, help="Answer in JSON.")
    return option(command)


def as_json() -> bool:
    """Whether the present command was asked for JSON."""
    return bool(click.get_current_context().meta.get(AS_JSON))


def say(value: Any, words: Callable[[], "RenderableType"]) -> None:
    """Say ``value`` in JSON or, by default, in words; models of the API may be in it."""
    if as_json():
        print_json(value, indent=2)
    else:
        console().print(words())


def print_json(value: Any, *, indent: int | None = None) -> None:
    """A value on standard output; on one line unless indented."""
    from pydantic_core import to_json

    click.echo(to_json(value, indent=indent).decode())


def show_error(ctx: click.Context, error: Exception, *, code: int) -> None:
    """An error as a paragraph on standard error; where JSON was asked for, as an object."""
    ids = {name: value for name in ("request_id", "job_id") if (value := getattr(error, name, None))}
    if ctx.meta.get(AS_JSON):
        from pydantic_core import to_json

        kind = getattr(error, "code", "os")
        problem = {"error": {"code": kind, "message": str(error), "exit_code": code, **ids}}
        click.echo(to_json(problem).decode(), err=True)
        return
    request = f" (request {ids['request_id']})" if "request_id" in ids else ""
    click.echo(f"trompe: {error}{request}", err=True)


def console(*, stderr: bool = False) -> "Console":
    """A console that takes the server's words literally, and that is wide where nobody's terminal limits it."""
    from rich.console import Console

    made = Console(stderr=stderr, markup=False, highlight=False, emoji=False)
    return made if made.is_terminal else Console(stderr=stderr, markup=False, highlight=False, emoji=False, width=160)
