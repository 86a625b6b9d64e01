"""Output of commands: tables for people, JSON for programs."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import click

from trompe_shared.api import in_flags
from trompe_shared.json_option import as_json

if TYPE_CHECKING:
    from rich.console import Console, RenderableType


def say(value: Any, words: Callable[[], "RenderableType"]) -> None:
    """Print ``value`` as JSON, with models of the API, or else ``words``."""
    if as_json():
        print_json(value, indent=2)
    else:
        console().print(words(), crop=False)


def print_json(value: Any, *, indent: int | None = None, err: bool = False) -> None:
    """Print a value as JSON, on one line unless indented."""
    from pydantic_core import to_json

    click.echo(to_json(value, indent=indent).decode(), err=err)


def show_error(error: Exception, *, code: int, flags: bool) -> None:
    """Print an error on standard error, as an object with --json. flags: whether its options are those of the command
    line, not of a file.
    """
    ids = {name: value for name in ("request_id", "job_id") if (value := getattr(error, name, None))}
    if as_json():
        kind = getattr(error, "code", "os")
        print_json({"error": {"code": kind, "message": str(error), "exit_code": code, **ids}}, err=True)
        return
    request = f" (request {ids['request_id']})" if "request_id" in ids else ""
    click.echo(f"trompe: {in_flags(str(error)) if flags else error}{request}", err=True)


def console(*, stderr: bool = False) -> "Console":
    """A console without markup, 160 columns wide if it is not a terminal."""
    from rich.console import Console

    made = Console(stderr=stderr, markup=False, highlight=False, emoji=False)
    return made if made.is_terminal else Console(stderr=stderr, markup=False, highlight=False, emoji=False, width=160)
