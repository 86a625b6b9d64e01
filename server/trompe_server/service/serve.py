"""``trompe serve``: starts and stops database, children and HTTP server in order."""

import resource
import signal
import socket
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from types import FrameType
from typing import Any, Final, NoReturn

import click
import sqlalchemy as sa
import uvicorn

from trompe_server.api.services import Services
from trompe_server.errors import ServiceError
from trompe_server.library import Library
from trompe_server.queue.store import JobStore
from trompe_server.renderers.discovery import RendererAddresses
from trompe_server.service.app import create_app
from trompe_server.service.dispatch import dispatching, prepare_data
from trompe_server.service.supervisor import Supervisor
from trompe_server.settings import Settings
from trompe_server.storage.folders import open_folder
from trompe_server.storage.tokens import Tokens
from trompe_server.system.files import exclusive
from trompe_shared.addresses import is_loopback

BACKLOG: Final = 2048
"""Connections waiting to be accepted."""
KEEP_ALIVE: Final = 75
"""Seconds an idle connection stays open: longer than at clients (httpx 5, most proxies 60). A request sent while the
server closes the connection is lost, so the client must close first."""
OPEN_FILES: Final = 65_536
CHECKPOINT_PAGES: Final = 10_000
"""Pages of 4 KiB in SQLite's log at which the API checkpoints; the workers do at 1000."""


def run_service(settings: Settings, elsewhere: RendererAddresses, *, host: str, port: int) -> None:
    """Serve until SIGTERM or SIGINT, with own renderers and those ``elsewhere``. Port 0 takes a free one.

    Prints one line once everything is ready. Raises ``ServiceError`` if the address is in use, the
    data folder cannot be used, or a child does not start.
    """
    _refuse_without_renderers(settings, elsewhere)
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, _leave)
    prepare_data(settings)
    _refuse_public(host, settings)
    in_use = (
        f"Another `trompe serve` uses the data folder {settings.data}; stop it, or choose another folder with --data."
    )
    with (
        exclusive(settings.data / "serve.lock", in_use),
        _listen(host, port) as listener,
        closing(Supervisor(settings, elsewhere)) as supervisor,
    ):
        supervisor.start()
        with _attack_workers(settings, supervisor.addresses) as missing:
            _serve_http(settings, supervisor, lambda: [*supervisor.missing(), *missing()], listener)


@contextmanager
def _attack_workers(settings: Settings, renderers: RendererAddresses) -> Iterator[Callable[[], list[str]]]:
    """Dispatch jobs during the block, unless all workers are elsewhere. Yields what is wrong with them, in words."""
    if not settings.workers:
        yield list
        return
    with dispatching(settings, renderers) as dispatcher:
        yield lambda: [dispatcher.fault] if dispatcher.fault else []


def _serve_http(
    settings: Settings,
    supervisor: Supervisor,
    missing: Callable[[], list[str]],
    listener: socket.socket,
) -> None:
    store, files = JobStore(settings.database_url, silence=settings.silence), open_folder(settings.store_url)
    if store.engine.dialect.name == "sqlite":
        sa.event.listen(store.engine, "connect", _avoid_checkpoints)
    library = Library(files.within("library"), cache=settings.data / "cache", networks=settings.networks)
    library.objects.all()  # reads the shipped ones before the first request
    tokens = Tokens(store.engine)
    services = Services(settings, library, store, files, tokens, supervisor.renderer_infos, missing)
    app = create_app(services)
    _allow_many_connections()
    config = uvicorn.Config(
        app,
        log_config=None,
        log_level="warning",
        timeout_keep_alive=KEEP_ALIVE,
        timeout_graceful_shutdown=5,
        backlog=BACKLOG,
        server_header=False,
    )
    try:
        _Server(config).run(sockets=[listener])
    finally:
        store.close()


def _allow_many_connections() -> None:
    """Raise the limit of open files as far as the system allows: each connection is one."""
    now, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    if now not in {most, resource.RLIM_INFINITY} and now < OPEN_FILES:
        wanted = OPEN_FILES if most == resource.RLIM_INFINITY else min(OPEN_FILES, most)
        resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, most))


def _avoid_checkpoints(connection: Any, _record: Any) -> None:
    """Leave checkpoints of SQLite's log, which wait for the disk, to the workers: nobody waits for their answers."""
    connection.execute(f"PRAGMA wal_autocheckpoint={CHECKPOINT_PAGES}")


class _Server(uvicorn.Server):
    """A server that announces its start, and ends in order however often it is told."""

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        if not self.should_exit:
            super().handle_exit(sig, frame)

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        await super().startup(sockets)
        for listener in sockets or ():
            click.echo(f"trompe serving on {_url(listener)}")


def _listen(host: str, port: int) -> socket.socket:
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        listener = socket.create_server((host, port), family=family, backlog=BACKLOG)
        # Connections inherit it; asyncio sets it only on sockets created with a protocol number. Without it every
        # answer waits some 40 ms for the client's acknowledgement of its first half.
        listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        return listener
    except OSError as error:
        raise ServiceError(
            f"Cannot listen on {host}:{port} ({error}). Choose another --port (0: a free one) or --host."
        ) from error


def _url(listener: socket.socket) -> str:
    host, port = listener.getsockname()[:2]
    return f"http://[{host}]:{port}" if ":" in host else f"http://{host}:{port}"


def _refuse_public(host: str, settings: Settings) -> None:
    if is_loopback(host):
        return
    with closing(JobStore(settings.database_url)) as store:
        closed = any(token.revoked is None for token in Tokens(store.engine).all())
    if not closed:
        raise ServiceError(
            f"{host} is reachable from other machines, and without a token anybody could use the service. "
            "Create one with: trompe token create NAME --right write; or use --host 127.0.0.1."
        )


def _refuse_without_renderers(settings: Settings, elsewhere: RendererAddresses) -> None:
    if settings.workers and not settings.renderers and elsewhere == RendererAddresses():
        raise ServiceError(
            f"{settings.workers} attack workers need a renderer: start some with --renderers, name some with "
            "--renderer HOST:PORT, or start no attack workers with --workers 0."
        )


def _leave(_number: int, _frame: FrameType | None) -> NoReturn:
    raise SystemExit(0)
