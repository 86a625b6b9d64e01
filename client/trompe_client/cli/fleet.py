"""Commands about what does the work: ``trompe workers``, ``trompe renderers``."""

import click

from trompe_client._client import Client
from trompe_client._report import renderers_table, workers_table
from trompe_client.cli.connection import with_client
from trompe_client.cli.output import json_option, say

__all__ = ["renderers", "workers"]


@click.command()
@json_option
@with_client
def workers(client: Client) -> None:
    """List the processes that run jobs."""
    found = client.workers()
    say(found, lambda: workers_table(found))


@click.command()
@json_option
@with_client
def renderers(client: Client) -> None:
    """List the renderer workers."""
    found = client.renderers()
    say(found, lambda: renderers_table(found))
