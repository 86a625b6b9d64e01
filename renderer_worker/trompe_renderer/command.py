"""``trompe render``: run a renderer worker."""

import logging
import signal
import socket
import sys

import click

from trompe_renderer.options import Options, Quality
from trompe_renderer.supervise import listen, supervise
from trompe_shared.errors import RendererError

__all__ = ["render"]


@click.command()
@click.option("--host", default="127.0.0.1", show_default=True, help="Address to listen on.")
@click.option(
    "--port", default=8085, show_default=True, type=click.IntRange(0, 65535), help="Port; 0 picks a free one."
)
@click.option("--shadows/--no-shadows", default=True, show_default=True, help="Whether lights cast shadows.")
@click.option(
    "--shadow-map",
    default=1024,
    show_default=True,
    type=click.IntRange(64, 16384),
    help="Texels along a shadow map's side.",
)
@click.option(
    "--msaa", default=4, show_default=True, type=click.IntRange(1, 32), help="Coverage samples of a pixel; 1 is none."
)
@click.option(
    "--supersample", default=1, show_default=True, type=click.IntRange(1, 4), help="Shaded samples along a pixel."
)
@click.option(
    "--anisotropy", default=1, show_default=True, type=click.IntRange(1, 16), help="Of texture filters; 1 is none."
)
@click.option(
    "--depth-range", default=10.0, show_default=True, type=click.FloatRange(1e-3, 1000), help="Metres shown as white."
)
@click.option(
    "--time-step", type=click.FloatRange(0, 3600), help="Seconds from frame to frame, instead of the clock's."
)
@click.option("--verbose", is_flag=True, help="Log every agent that comes and goes.")
def render(
    host: str,
    port: int,
    *,
    shadows: bool,
    shadow_map: int,
    msaa: int,
    supersample: int,
    anisotropy: int,
    depth_range: float,
    time_step: float | None,
    verbose: bool,
) -> None:
    """Run a renderer worker: it speaks SAILenv's socket protocol and renders with pyrender.

    What each option costs stands in docs/worker.md.

    There is no authentication: keep it on an address that only those reach who may use it.
    """
    logging.basicConfig(stream=sys.stderr, level=logging.INFO if verbose else logging.WARNING, format="%(message)s")
    options = Options(Quality(shadows, msaa, shadow_map, supersample, anisotropy), depth_range, time_step)
    try:
        listener = listen(host, port)
    except RendererError as error:
        raise click.ClickException(str(error)) from error
    sys.exit(supervise(lambda: _work(listener, options)))


def _work(listener: socket.socket, options: Options) -> int:
    """Serve until SIGTERM; the exit status."""
    from trompe_renderer.platform import give_memory_back  # OpenGL is loaded only by those who render
    from trompe_renderer.server import Server

    give_memory_back()
    try:
        server = Server(listener, options)
    except RendererError as error:
        click.echo(f"Error: {error}", err=True)
        return 1
    signal.signal(signal.SIGTERM, lambda *_: server.stop())
    click.echo("trompe renderer listening on {}:{}".format(*server.address))
    server.serve_forever()
    return 0
