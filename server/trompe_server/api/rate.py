"""Rate limit of requests by client."""

import time
from collections.abc import Callable
from typing import Final

BURST: Final = 20.0
"""Seconds of requests that an idle client may make at once."""
MAX_CLIENTS: Final = 10_000
"""Clients in memory; the least recent ones are dropped."""


class RateLimit:
    """``rate`` requests per second for each client; 0 sets no limit. Implements the generic cell rate algorithm."""

    def __init__(self, rate: float, *, clock: Callable[[], float] = time.monotonic) -> None:
        self._rate, self._clock = rate, clock
        self._full_at: dict[str, float] = {}

    def wait(self, client: str) -> float:
        """Count one request of ``client``. Returns the seconds until it is allowed, 0 for at once."""
        if not self._rate:
            return 0.0
        now = self._clock()
        full_at = max(self._full_at.pop(client, now), now)
        late = full_at + 1 / self._rate - now - BURST
        self._full_at[client] = full_at if late > 0 else full_at + 1 / self._rate
        if len(self._full_at) > MAX_CLIENTS:
            del self._full_at[next(iter(self._full_at))]
        return max(late, 0.0)
