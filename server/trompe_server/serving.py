"""``trompe serve``: children, database and HTTP server, put up in order and taken down in order."""

import ipaddress
import signal
import socket
from collections.abc import Callable
from types import FrameType
from typing import NoReturn

import uvicorn

from trompe_server.api.services import Services
from trompe_server.app import create_app
from trompe_server.errors import ServiceError
from trompe_server.files import exclusive
from trompe_server.jobs.engine import DbosQueue
from trompe_server.jobs.store import JobStore
from trompe_server.jobs.supervisor import Supervisor
from trompe_server.jobs.worker import prepare_data
from trompe_server.library import Library
from trompe_server.settings import Settings

__all__ = ["run_service"]


def run_service(settings: Settings, *, host: str, port: int, announce: Callable[[str], None]) -> None:
    """Serve until SIGTERM or SIGINT. ``announce`` is given one line once everything is up; port 0 takes a free one.

    Raises ``ServiceError`` where the address, the data folder or one of the children is not to be had.
    """
    _refuse_public(host, settings)
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, _leave)
    prepare_data(settings)
    with (
        exclusive(settings.data / "serve.lock", _in_use(settings)),
        _listen(host, port) as listener,
        Supervisor(settings) as supervisor,
    ):
        supervisor.start()
        _serve_http(settings, supervisor, listener, announce)


def _serve_http(
    settings: Settings, supervisor: Supervisor, listener: socket.socket, announce: Callable[[str], None]
) -> None:
    store, queue, library = JobStore(settings.database), DbosQueue(settings.database), Library(settings.library)
    app = create_app(Services(settings, library, store, queue, supervisor.missing))
    config = uvicorn.Config(app, log_level="warning", timeout_graceful_shutdown=5)
    try:
        _Server(config, lambda: announce(f"trompe serving on {_url(listener)}")).run(sockets=[listener])
    finally:
        queue.close()
        store.close()


class _Server(uvicorn.Server):
    """Says when it is up."""

    def __init__(self, config: uvicorn.Config, announce: Callable[[], None]) -> None:
        super().__init__(config)
        self._announce = announce

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        await super().startup(sockets)
        self._announce()


def _listen(host: str, port: int) -> socket.socket:
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        return socket.create_server((host, port), family=family, backlog=128)
    except OSError as error:
        raise ServiceError(
            f"Cannot listen on {host}:{port} ({error}). Choose another --port (0 takes a free one) or --host."
        ) from error


def _url(listener: socket.socket) -> str:
    host, port = listener.getsockname()[:2]
    return f"http://[{host}]:{port}" if ":" in host else f"http://{host}:{port}"


def _refuse_public(host: str, settings: Settings) -> None:
    if _is_loopback(host) or settings.allow_public:
        return
    raise ServiceError(
        f"{host} can be reached from other machines, and the service asks nobody for a password. Use --host 127.0.0.1, "
        "or set TROMPE_ALLOW_PUBLIC=1 where something in front of it decides who may come in."
    )


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def _in_use(settings: Settings) -> str:
    return (
        f"Another `trompe serve` uses the data folder {settings.data}; stop it, or choose another folder with --data."
    )


def _leave(_number: int, _frame: FrameType | None) -> NoReturn:
    raise SystemExit(0)
