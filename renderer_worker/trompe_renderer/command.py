"""``trompe render``: run a renderer worker until a signal or a crash ends it. Restarts are the caller's work."""

import ctypes
import faulthandler
import logging
import os
import re
import signal
import socket
import sys
from collections.abc import Callable, Mapping
from types import FrameType
from typing import Final, NoReturn

import click

from trompe_renderer.protocol.limits import Options
from trompe_shared.engine import DEFAULT_ENGINE
from trompe_shared.errors import RendererError

BACKLOG: Final = 64
"""Connections that wait until the worker accepts them."""
_M_TRIM_THRESHOLD: Final = -1
_M_MMAP_THRESHOLD: Final = -3
_LARGE_BLOCK: Final = 2**20


def _pairs(_context: click.Context, _option: click.Parameter, given: tuple[str, ...]) -> dict[str, str]:
    wrong = next((each for each in given if not re.match(r"\w+=", each)), None)
    if wrong is not None:
        raise click.BadParameter(f"{wrong!r} is not NAME=VALUE.")
    return dict(each.split("=", 1) for each in given)


@click.command()
@click.option("--host", default="127.0.0.1", show_default=True, help="Address to listen on.")
@click.option(
    "--port", default=8085, show_default=True, type=click.IntRange(0, 65535), help="Port; 0 picks a free one."
)
@click.option(
    "--engine",
    default=DEFAULT_ENGINE,
    show_default=True,
    metavar="NAME",
    help="pyrender, three, panda3d, mitsuba, cycles, or your own as module:Class.",
)
@click.option(
    "--set",
    "settings",
    multiple=True,
    metavar="NAME=VALUE",
    callback=_pairs,
    help="An option of the engine; repeatable.",
)
@click.option(
    "--depth-range",
    default=Options.depth_range,
    show_default=True,
    type=click.FloatRange(1e-3, 1000),
    help="Metres shown as white in depth views.",
)
@click.option(
    "--time-step", type=click.FloatRange(0, 3600), help="Seconds from frame to frame; the clock's by default."
)
@click.option(
    "--check",
    is_flag=False,
    flag_value="",
    metavar="[HOST:PORT]",
    help="Check the engine, or a running renderer (SAILenv, too), with 40 pictures and exit; status 1 means a fault.",
)
@click.option("--verbose", is_flag=True, help="Log agents that connect and leave.")
def render(
    host: str,
    port: int,
    *,
    engine: str,
    settings: Mapping[str, str],
    check: str | None,
    verbose: bool,
    **options: float | None,
) -> None:
    """Run a renderer worker: it speaks SAILenv's socket protocol and renders with an engine of your choice.

    docs/engines.md lists the engines and their options, docs/worker.md the costs of pyrender's.

    There is no authentication: listen only on an address that no stranger can reach.
    """
    try:
        if check is not None:
            from trompe_renderer.check.report import check_at, check_engine

            sys.exit(not (check_at(check) if check else check_engine(engine, settings)))
        logging.basicConfig(stream=sys.stderr, level=logging.INFO if verbose else logging.WARNING, format="%(message)s")
        faulthandler.enable()
        stop = _StopSignals()
        _serve(_listen(host, port), engine, settings, Options(**options), stop)  # type: ignore[arg-type]
    except RendererError as error:
        raise click.ClickException(str(error)) from error
    stop.exit()


def _listen(host: str, port: int) -> socket.socket:
    try:
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        return socket.create_server((host, port), family=family, backlog=BACKLOG)
    except OSError as error:
        raise RendererError(f"Cannot listen on {host}:{port} ({error}). Choose another --host or --port.") from error


class _StopSignals:
    """On SIGTERM (exit status 0) or SIGINT (130) calls ``stop_server``, which ends the process until there is one."""

    def __init__(self) -> None:
        self.stop_server: Callable[[], None] = self.exit
        self._status = 0
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, self._receive)

    def _receive(self, number: int, _frame: FrameType | None) -> None:
        self._status = 128 + number if number == signal.SIGINT else 0
        self.stop_server()

    def exit(self) -> NoReturn:
        """End the process without waiting for threads that still draw."""
        logging.shutdown()
        sys.stdout.flush()
        os._exit(self._status)


def _serve(
    listener: socket.socket, engine: str, settings: Mapping[str, str], options: Options, stop: _StopSignals
) -> None:
    from trompe_renderer.engines.loading import engine_maker  # NumPy and more; --help works without it
    from trompe_renderer.engines.render_thread import RenderThread
    from trompe_renderer.protocol.server import Server

    _return_freed_memory()
    thread = RenderThread(engine_maker(engine, settings))
    server = Server(listener, thread, options)
    stop.stop_server = server.stop
    host, port = server.address
    click.echo(f"trompe renderer listening on {f'[{host}]' if ':' in host else host}:{port}, {thread.info}")
    server.serve_forever()


def _return_freed_memory() -> None:
    """Make glibc return large freed blocks to the system at once. By default it soon keeps the largest pictures'."""
    libc = ctypes.CDLL(None)
    if hasattr(libc, "mallopt"):
        for parameter in (_M_MMAP_THRESHOLD, _M_TRIM_THRESHOLD):
            libc.mallopt(parameter, _LARGE_BLOCK)
