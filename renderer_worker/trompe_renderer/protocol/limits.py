"""Options of a worker, and limits on its agents: time, bytes, numbers."""

import contextlib
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from weakref import WeakKeyDictionary

from trompe_shared.errors import RendererError

MIB = 2**20


@dataclass(frozen=True)
class Options:
    """depth_range: metres shown as white in depth views. time_step: seconds between frames; the clock's if none."""

    depth_range: float = 10.0
    time_step: float | None = None


@dataclass(frozen=True)
class Limits:
    """Limits of one worker, in seconds and bytes. The defaults are those of docs/worker.md.

    agents: connections at a time.
    idle_timeout: silence after which an agent may lose its place to a new one.
    register_timeout: for the handshake.
    request_timeout: for the rest of a request after its first byte, and for an answer to be taken.
    stop_timeout: for answers that are due when the worker stops.
    request_size: of one request.
    free_request_size: of a request outside ``requests_total``.
    requests_total: of all requests in transit.
    free_frame_size: of a frame or batch outside ``frames_total``.
    frames_total: of all frames in drawing and transit.
    uploads, uploads_total: stored archives of one agent (the oldest go first), and of all agents.
    textures, textures_total: textures of one agent's spawned objects, and of all agents' objects.
    cached_models, cached_size: number and size of parsed models; the last one always stays.
    large_archive: unpacked size of archives that are parsed one after the other.
    """

    agents: int = 64
    idle_timeout: float = 600.0
    register_timeout: float = 10.0
    request_timeout: float = 60.0
    stop_timeout: float = 8.0
    request_size: int = 512 * MIB
    free_request_size: int = MIB
    requests_total: int = 1024 * MIB
    free_frame_size: int = 32 * MIB
    frames_total: int = 1024 * MIB
    uploads: int = 64 * MIB
    uploads_total: int = 1024 * MIB
    textures: int = 1024 * MIB
    textures_total: int = 4096 * MIB
    cached_models: int = 8
    cached_size: int = 1024 * MIB
    large_archive: int = 64 * MIB


class MemoryBudget:
    """Memory shared by all agents. An agent that asks for more than is free waits for the others."""

    def __init__(self, total: int) -> None:
        self._total = self._free = total
        self._freed = threading.Condition()
        self._queue = threading.Lock()

    def take(self, count: int, *, timeout: float | None) -> None:
        """Reserve ``count`` bytes. Raises ``TimeoutError`` if they do not become free in ``timeout`` seconds."""
        with self._freed:
            if not self._freed.wait_for(lambda: self._free >= count, timeout):
                raise TimeoutError("other agents' uploads leave no memory for this one")
            self._free -= count

    def give_back(self, count: int) -> None:
        """End a reservation."""
        with self._freed:
            self._free += count
            self._freed.notify_all()

    @contextlib.contextmanager
    def reserved(self, count: int) -> Iterator[None]:
        """Reserve ``count`` bytes, or the whole budget if that is less, within a ``with`` block.

        Large requests keep their place in the queue: small ones do not overtake them.
        """
        share = min(count, self._total)
        with self._queue:
            self.take(share, timeout=None)
        try:
            yield
        finally:
            self.give_back(share)


class StorageQuota:
    """Bytes stored by many holders, at most ``total`` together. A holder's share ends with the holder."""

    def __init__(self, total: int) -> None:
        self._total = total
        self._held: WeakKeyDictionary[object, int] = WeakKeyDictionary()
        self._lock = threading.Lock()

    def hold(self, holder: object, count: int) -> None:
        """Set the share of ``holder`` to ``count`` bytes. Raises ``RendererError`` if that does not fit."""
        with self._lock:
            others = sum(held for other, held in self._held.items() if other is not holder)
            if count > self._held.get(holder, 0) and others + count > self._total:
                raise RendererError(
                    f"All agents together may store {self._total // MIB} MiB here; others store {others // MIB} MiB, "
                    f"so {max(count // MIB, 1)} MiB do not fit. Try again after others have left."
                )
            self._held[holder] = count
