"""When a request is sent again, and after which pause."""

import random
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from trompe_client._errors import APIError, BrokenDownload, ClientError, ServerUnreachable

__all__ = ["Retries"]

PASSING: Final = frozenset({429, 502, 503, 504})
"""What a server says, or something on the way to it, that may be itself again in a moment."""


@dataclass(frozen=True)
class Retries:
    """Exponential backoff with full jitter: the n-th pause is drawn from 0 to ``base * 2**n``, at most ``longest``.

    A server that names a pause by Retry-After gets it, and a little more, so that not all clients come back at once;
    one that asks for more than ``patience`` is not waited for. Times are in seconds; ``limit=0`` tries once only.
    """

    limit: int = 4
    base: float = 0.25
    longest: float = 8.0
    patience: float = 60.0
    random: Callable[[], float] = random.random

    def pause(self, error: ClientError, *, attempt: int) -> float | None:
        """How long to wait before request number ``attempt`` (from 0), which failed, is sent again; None: it is not."""
        pause = self.delay(error, attempt=attempt)
        again = attempt < self.limit and pause <= self.patience + self.longest
        return pause if again and _passes(error) else None

    def delay(self, error: ClientError, *, attempt: int) -> float:
        """What the server asks for, and the jitter."""
        asked = error.retry_after or 0.0 if isinstance(error, APIError) else 0.0
        return asked + self.random() * min(self.longest, self.base * 2.0 ** min(attempt, 30))


def _passes(error: ClientError) -> bool:
    """Whether the same request may do better next time."""
    return isinstance(error, ServerUnreachable | BrokenDownload) or (
        isinstance(error, APIError) and error.status in PASSING
    )
