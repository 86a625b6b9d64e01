"""Limit and pauses of retries."""

import random
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from trompe_client._errors import APIError, BrokenDownload, ClientError, ServerUnreachable

PASSING: Final = frozenset({429, 502, 503, 504})
"""Statuses of temporary errors, of the server or a proxy."""


@dataclass(frozen=True)
class Retries:
    """Exponential backoff with full jitter: the n-th pause is drawn from 0 to ``base * 2**n``, at most ``longest``.

    A server's Retry-After is added to it; above ``patience`` the error is raised. Times are in seconds; ``limit=0``
    means a single attempt.
    """

    limit: int = 4
    base: float = 0.25
    longest: float = 8.0
    patience: float = 60.0
    random: Callable[[], float] = random.random

    def pause(self, error: ClientError, *, attempt: int) -> float | None:
        """Pause after failed attempt number ``attempt`` (from 0), or None for no retry."""
        pause = self.delay(error, attempt=attempt)
        again = attempt < self.limit and pause <= self.patience + self.longest
        return pause if again and _passes(error) else None

    def delay(self, error: ClientError, *, attempt: int) -> float:
        """The server's Retry-After plus jitter."""
        asked = error.retry_after or 0.0 if isinstance(error, APIError) else 0.0
        return asked + self.random() * min(self.longest, self.base * 2.0 ** min(attempt, 30))


def _passes(error: ClientError) -> bool:
    return isinstance(error, ServerUnreachable | BrokenDownload) or (
        isinstance(error, APIError) and error.status in PASSING
    )
