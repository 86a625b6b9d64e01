"""Options of the connection to a server."""

import functools
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import click

from trompe_client._client import Client
from trompe_client._embedded import embedded_server
from trompe_client._settings import DEFAULT_SERVER
from trompe_client.cli.output import console
from trompe_shared.json_option import json_option

F = TypeVar("F", bound=Callable[..., Any])


def server_option(without: str | None) -> Callable[[F], F]:
    """--server; ``without`` is its default, None for a server of the command's own."""
    text = f"Address of a running server (or TROMPE_SERVER). Default: {without or 'start one for this command'}."
    return click.option("--server", envvar="TROMPE_SERVER", metavar="URL", default=without, help=text)


token_option = click.option(
    "--token",
    envvar="TROMPE_TOKEN",
    metavar="TOKEN",
    help="Access token. Better: TROMPE_TOKEN, which other users cannot see.",
)


def with_client(command: Callable[..., None]) -> Callable[..., None]:
    """Add --json, --server and --token to a command, and pass it the server's client as first argument."""

    @json_option
    @server_option(DEFAULT_SERVER)
    @token_option
    @functools.wraps(command)
    def run(*args: Any, server: str, token: str | None, **options: Any) -> None:
        with Client(server, token=token) as client:
            command(client, *args, **options)

    return run


class _Folder(click.Path):
    """A folder; the empty word, which would mean the current one, is a variable without a value."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        if value == "":
            self.fail("it is empty; give a folder, or . for the current one.", param, ctx)
        return super().convert(value, param, ctx)


def out_option(*, required: bool, help: str) -> Callable[[F], F]:
    """--out: a folder."""
    kind = _Folder(file_okay=False, path_type=Path)
    return click.option("--out", required=required, type=kind, metavar="DIR", help=help)


@contextmanager
def service(server: str | None, token: str | None) -> Iterator[Client]:
    """A client of the server at ``server``, or of an embedded one that runs for the block."""
    if server is not None:
        with Client(server, token=token) as client:
            yield client
        return
    screen = console(stderr=True)
    if not screen.is_terminal:
        screen.print("starting the service")
    with screen.status("starting the service") as status, embedded_server() as url:
        status.stop()
        with Client(url, token=token) as client:
            yield client
