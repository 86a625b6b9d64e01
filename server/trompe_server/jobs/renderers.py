"""Where the renderer workers are: a list of addresses, or a name that the DNS resolves to as many as there are."""

import itertools
import logging
import socket
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from trompe_server.target.protocol import TargetRenderer
from trompe_shared.errors import RendererError
from trompe_shared.geometry import View
from trompe_shared.object3d import Object3D

__all__ = ["Address", "RendererFleet", "Renderers", "wait_for_renderer"]

logger = logging.getLogger(__name__)

Address = tuple[str, int]

RESOLVE_INTERVAL: Final = 10.0
"""Seconds after which a name is resolved anew: renderers come and go."""


@dataclass(frozen=True)
class Renderers:
    """Renderer workers at the addresses ``listed``, or at all addresses of the names in ``dns``."""

    listed: tuple[Address, ...] = ()
    dns: tuple[Address, ...] = ()

    def addresses(self) -> list[Address]:
        """Where they are now. Raises ``RendererError`` where a name cannot be resolved and nothing else is known."""
        found = list(self.listed)
        for name, port in self.dns:
            try:
                infos = socket.getaddrinfo(name, port, type=socket.SOCK_STREAM)
            except OSError as error:
                logger.warning("the name %s of the renderers cannot be resolved: %s", name, error)
                continue
            found += [(str(info[4][0]), port) for info in infos]
        if not found:
            names = ", ".join(name for name, _ in self.dns)
            raise RendererError(f"No renderer is known by the name {names!r}; start some, or check --renderers-dns.")
        return sorted(dict.fromkeys(found))


def wait_for_renderer(renderers: Renderers, *, seconds: float) -> list[Address]:
    """Their addresses, once one of them accepts connections. Raises ``RendererError`` after ``seconds``."""
    deadline = time.monotonic() + seconds
    while True:
        try:
            return _one_accepts(renderers.addresses())
        except (OSError, RendererError) as error:
            if time.monotonic() > deadline:
                raise error if isinstance(error, RendererError) else RendererError(_nobody(renderers, error)) from error
        time.sleep(0.3)


def _one_accepts(addresses: list[Address]) -> list[Address]:
    for number, address in enumerate(addresses, 1):
        try:
            socket.create_connection(address, timeout=2.0).close()
            return addresses
        except OSError:
            if number == len(addresses):
                raise
    raise AssertionError("there is at least one address")


def _nobody(renderers: Renderers, error: OSError) -> str:
    where = ", ".join(f"{host}:{port}" for host, port in itertools.chain(renderers.listed, renderers.dns))
    return (
        f"No renderer answers at {where} ({error}). Start one with: trompe render --host HOST --port PORT; "
        "`trompe doctor` says whether this machine can render."
    )


class RendererFleet:
    """A ``TargetRenderer`` over renderers whose addresses change: it looks anew between two requests.

    ``make`` gives the target of a list of addresses.
    """

    def __init__(self, renderers: Renderers, make: Callable[[Sequence[Address]], TargetRenderer]) -> None:
        self._renderers, self._make = renderers, make
        self._addresses = renderers.addresses()
        self._target = make(self._addresses)
        self._looked = time.monotonic()

    def render(
        self,
        obj: Object3D,
        views: Sequence[View],
        *,
        size: tuple[int, int],
        on_frame: Callable[[], None] | None = None,
    ) -> NDArray[np.uint8]:
        """See ``TargetRenderer``."""
        if time.monotonic() - self._looked > RESOLVE_INTERVAL:
            self._look()
        return self._target.render(obj, views, size=size, on_frame=on_frame)

    def close(self) -> None:
        """See ``TargetRenderer``."""
        self._target.close()

    def _look(self) -> None:
        self._looked = time.monotonic()
        try:
            addresses = self._renderers.addresses()
        except RendererError:
            return
        if addresses != self._addresses:
            logger.info("the renderers are at %s now", addresses)
            self._target.close()
            self._addresses, self._target = addresses, self._make(addresses)
