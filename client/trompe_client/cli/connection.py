"""The options that say which server a command talks to."""

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

__all__ = ["out_option", "server_option", "service", "token_option", "with_client"]

F = TypeVar("F", bound=Callable[..., Any])


def server_option(without: str | None) -> Callable[[F], F]:
    """--server; ``without`` it is this address, or a server of the command's own."""
    text = f"Address of a running server (or TROMPE_SERVER). Default: {without or 'start one for this command'}."
    return click.option("--server", envvar="TROMPE_SERVER", metavar="URL", default=without, help=text)


token_option = click.option(
    "--token", envvar="TROMPE_TOKEN", metavar="TOKEN", help="What the server asks for (or, better, TROMPE_TOKEN)."
)


def with_client(command: Callable[..., None]) -> Callable[..., None]:
    """Give a command --server and --token, and the client that they make as its first argument."""

    @server_option(DEFAULT_SERVER)
    @token_option
    @functools.wraps(command)
    def run(*args: Any, server: str, token: str | None, **options: Any) -> None:
        with Client(server, token=token) as client:
            command(client, *args, **options)

    return run


def out_option(*, required: bool, help: str) -> Callable[[F], F]:
    """--out, a folder."""
    kind = click.Path(file_okay=False, path_type=Path)
    return click.option("--out", required=required, type=kind, metavar="DIR", help=help)


@contextmanager
def service(server: str | None, token: str | None) -> Iterator[Client]:
    """A client of the server at ``server``, or of one that runs as long as the block."""
    if server is not None:
        with Client(server, token=token) as client:
            yield client
        return
    with _embedded_with_spinner() as url, Client(url, token=token) as client:
        yield client


@contextmanager
def _embedded_with_spinner() -> Iterator[str]:
    status = console(stderr=True).status("starting the service for this command")
    status.start()
    try:
        with embedded_server() as url:
            status.stop()
            yield url
    finally:
        status.stop()
