"""The command ``trompe token``: creates, lists and revokes tokens directly in the database, without a server."""

import json
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import click

from trompe_server.service.commands import data_option, database_option, settings_of
from trompe_server.settings import Settings
from trompe_server.storage.tokens import Right, Token, Tokens
from trompe_shared.json_option import as_json, json_option


def _where(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add the options that locate the database."""
    return data_option(database_option(command))


@click.group()
def token() -> None:
    """Create, list and revoke access tokens of the service."""


@token.command()
@click.argument("name")
@click.option(
    "--right",
    type=click.Choice([right.value for right in Right]),
    default=Right.write.value,
    show_default=True,
    help="read: look only; write: also submit, cancel, delete and upload.",
)
@json_option
@_where
def create(name: str, right: str, data: Path | None, database: str | None) -> None:
    """Create a token called NAME. Its secret is printed once and not stored."""
    with _tokens(settings_of(data, database=database)) as tokens:
        secret = tokens.create(name, Right(right))
    if as_json():
        click.echo(json.dumps({"name": name, "right": right, "secret": secret}))
        return
    click.echo(secret)
    click.echo("Save it now: it is not shown again. Clients read it from TROMPE_TOKEN or token=.", err=True)


@token.command("list")
@json_option
@_where
def show(data: Path | None, database: str | None) -> None:
    """List all tokens, revoked ones included."""
    with _tokens(settings_of(data, database=database)) as tokens:
        rows = [_row(each) for each in tokens.all()]
    if as_json():
        click.echo(json.dumps(rows))
        return
    if not rows:
        click.echo("There are no tokens: the service is open and listens on this machine only.", err=True)
    for row in rows:
        state = f"revoked {row['revoked']}" if row["revoked"] else f"last used {row['last_used'] or 'never'}"
        click.echo(f"{row['name']:24} {row['right']:6} created {row['created']}  {state}")


@token.command()
@click.argument("name")
@_where
def revoke(name: str, data: Path | None, database: str | None) -> None:
    """Revoke the token NAME; running servers refuse it within a second."""
    with _tokens(settings_of(data, database=database)) as tokens:
        tokens.revoke(name)
    click.echo(f"revoked {name}", err=True)


@contextmanager
def _tokens(settings: Settings) -> Iterator[Tokens]:
    """Open the tokens in the database of ``settings``; create the database if it is missing."""
    from trompe_server.queue.store import JobStore
    from trompe_server.service.dispatch import prepare_data

    prepare_data(settings)
    with closing(JobStore(settings.database_url)) as store:
        yield Tokens(store.engine)


def _row(each: Token) -> dict[str, str | None]:
    times = {"created": each.created, "last_used": each.last_used, "revoked": each.revoked}
    told = {name: time.isoformat(timespec="seconds") if time else None for name, time in times.items()}
    return {"name": each.name, "right": each.right.value, **told}
