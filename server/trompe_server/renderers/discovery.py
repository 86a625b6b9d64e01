"""Renderer workers at addresses, listed or resolved from a DNS name, and their engines."""

import logging
import socket
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Final

from trompe_server.renderers.choice import listed
from trompe_server.renderers.pool import Address, RendererPool
from trompe_server.renderers.protocol import Images, OnFrame, TargetRenderer
from trompe_shared.engine import EngineInfo
from trompe_shared.errors import RendererError, RendererLostError
from trompe_shared.geometry import View
from trompe_shared.object3d import Object3D
from trompe_shared.sailenv_client import SailenvTarget, engine_at

logger = logging.getLogger(__name__)

RESOLVE_INTERVAL: Final = 10.0
"""Seconds between two resolutions of a name: renderers come and go."""
PATIENCE: Final = 5.0
"""Seconds an asked renderer has to tell its engine."""
MAX_PROBES: Final = 16
"""Renderers asked at the same time."""


@dataclass(frozen=True)
class RendererAddresses:
    """The addresses ``listed``, and all addresses of the names in ``dns``."""

    listed: tuple[Address, ...] = ()
    dns: tuple[Address, ...] = ()

    def addresses(self) -> list[Address]:
        """The current addresses: the listed ones in their order, then others. Raises ``RendererError`` for none."""
        found = list(self.listed)
        for name, port in self.dns:
            try:
                infos = socket.getaddrinfo(name, port, type=socket.SOCK_STREAM)
            except OSError as error:
                logger.warning("the renderers' name %s cannot be resolved: %s", name, error)
                continue
            found += sorted((str(info[4][0]), port) for info in infos)
        if not found:
            names = ", ".join(name for name, _ in self.dns)
            raise RendererError(f"The name {names!r} resolves to no renderer; start one, or check --renderers-dns.")
        return list(dict.fromkeys(found))


def engines_at(addresses: Sequence[Address]) -> dict[Address, EngineInfo | None]:
    """The engine at each address, in their order; ``None`` where none answers in time."""
    with ThreadPoolExecutor(max(1, min(MAX_PROBES, len(addresses)))) as pool:
        return dict(zip(addresses, pool.map(lambda each: engine_at(*each, timeout=PATIENCE), addresses), strict=True))


class DiscoveredRenderers:
    """A ``TargetRenderer`` over the renderers with ``engine``; resolves their addresses anew between requests.

    Raises ``RendererLostError`` if none has the engine.
    """

    def __init__(self, renderers: RendererAddresses, engine: EngineInfo) -> None:
        self.engine, self._renderers = engine, renderers
        self._addresses = renderers.addresses()
        self._target = self._connected()
        self._looked = time.monotonic()

    def render(
        self, obj: Object3D, views: Sequence[View], *, size: tuple[int, int], on_frame: OnFrame | None = None
    ) -> Images:
        """Render with the current renderers. Arguments as in ``TargetRenderer.render``."""
        if time.monotonic() - self._looked > RESOLVE_INTERVAL:
            self._look()
        return self._target.render(obj, views, size=size, on_frame=on_frame)

    def close(self) -> None:
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
            self._addresses = addresses
            self._target = self._connected()

    def _connected(self) -> TargetRenderer:
        first, *others = found = self._with_engine()
        return RendererPool(found, engine=self.engine) if others else SailenvTarget(*first, engine=self.engine)

    def _with_engine(self) -> list[Address]:
        """The addresses with the engine, then the silent ones: they are asked again when they are needed."""
        found = engines_at(self._addresses)
        if answering := [address for address, engine in found.items() if engine == self.engine]:
            return answering + [address for address, engine in found.items() if engine is None]
        there = listed({engine for engine in found.values() if engine})
        raise RendererLostError(f"No renderer with {self.engine} answers. There are: {there}.")
