"""How many requests one client may make: a bucket for each, which refills all the time."""

import time
from collections.abc import Callable
from typing import Final

__all__ = ["BURST", "RateLimit"]

BURST: Final = 20.0
"""A client that was quiet may make the requests of so many seconds at once."""
MAX_CLIENTS: Final = 10_000
"""Clients that are remembered; those heard of longest ago are forgotten first."""


class RateLimit:
    """``rate`` requests per second for each client; 0 sets no limit.

    Of each bucket one number is kept, the moment at which it will be full again (the generic cell rate algorithm).
    """

    def __init__(self, rate: float, *, clock: Callable[[], float] = time.monotonic) -> None:
        self._rate, self._clock = rate, clock
        self._full_at: dict[str, float] = {}

    def wait(self, client: str) -> float:
        """Count one request of ``client``: 0 where it may be made, else the seconds until one may be."""
        if not self._rate:
            return 0.0
        now = self._clock()
        full_at = max(self._full_at.pop(client, now), now)
        late = full_at + 1 / self._rate - now - BURST
        self._full_at[client] = full_at if late > 0 else full_at + 1 / self._rate
        if len(self._full_at) > MAX_CLIENTS:
            del self._full_at[next(iter(self._full_at))]
        return max(late, 0.0)
