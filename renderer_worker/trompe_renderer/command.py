"""``trompe render``: run a renderer worker."""

import logging
import sys

import click

__all__ = ["render"]


@click.command()
@click.option("--host", default="127.0.0.1", show_default=True, help="Address to listen on.")
@click.option(
    "--port", default=8085, show_default=True, type=click.IntRange(0, 65535), help="Port; 0 picks a free one."
)
@click.option("--shadows/--no-shadows", default=True, show_default=True, help="Whether lights cast shadows.")
@click.option("--verbose", is_flag=True, help="Log every agent that comes and goes.")
def render(host: str, port: int, *, shadows: bool, verbose: bool) -> None:
    """Run a renderer worker: it speaks SAILenv's socket protocol and renders with pyrender.

    There is no authentication: keep it on an address that only those reach who may use it.
    """
    logging.basicConfig(stream=sys.stderr, level=logging.INFO if verbose else logging.WARNING, format="%(message)s")
    from trompe_renderer.server import Server  # OpenGL is loaded only by those who render
    from trompe_shared.errors import RendererError

    try:
        server = Server(host, port, shadows=shadows)
    except RendererError as error:
        raise click.ClickException(str(error)) from error
    click.echo("trompe renderer listening on {}:{}".format(*server.address))
    try:
        server.serve_forever()
    except KeyboardInterrupt:
        sys.exit(130)
