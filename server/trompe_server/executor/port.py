"""The port between the dispatcher and whatever runs attempts."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

from trompe_server.queue.claims import Claim
from trompe_server.queue.workers import Worker
from trompe_shared.api import Needs


@dataclass(frozen=True)
class Ended:
    """An attempt that no longer runs. ``reason``: why it died; ``None`` if it wrote its end to the record itself."""

    claim: Claim
    reason: str | None = None


class Executor(Protocol):
    """Runs attempts, each in a process of its own while it runs. Not safe for threads.

    Every method raises ``ServiceError`` if the executor as a whole is lost; then all its attempts are.
    """

    def place(self, needs: Needs) -> str | None:
        """A worker with room for an attempt with these needs now; ``None`` without one."""
        ...

    def submit(self, claim: Claim) -> None:
        """Start an attempt on ``claim.job.worker``, which ``place`` named."""
        ...

    def cancel(self, claim: Claim) -> None:
        """Kill an attempt. A frozen one may go on later: the record refuses its writes. It is not reported as ended."""
        ...

    def ended(self, timeout: float) -> list[Ended]:
        """Attempts that ended since the last call. Waits up to ``timeout`` seconds for one."""
        ...

    def workers(self) -> list[Worker]:
        """The living workers."""
        ...

    def unmet(self, waiting: Mapping[Needs, int]) -> dict[Needs, str]:
        """Of the needs of queued jobs, with their numbers, those that no worker can ever meet, and why.

        An executor that grows on demand also learns its demand here.
        """
        ...

    def close(self) -> None:
        """Kill all attempts and end all processes."""
        ...


def fits(needs: Needs, room: Needs) -> bool:
    """Whether an attempt with ``needs`` fits into ``room``."""
    return all(wanted <= free + 1e-6 for (_, wanted), (_, free) in zip(needs, room, strict=True))


def left_in(room: Needs, running: Iterable[Claim]) -> Needs:
    """What attempts leave of a ``room``."""
    taken = [claim.job.needs for claim in running]
    left = {name: amount - sum(getattr(needs, name) for needs in taken) for name, amount in room}
    return Needs.model_construct(**left)


def too_much(needs: Needs, rooms: Sequence[Needs]) -> str:
    """Why a job waits whose ``needs`` fit into none of ``rooms``."""
    there = "; ".join(sorted({f"{room}" for room in rooms})) or "none"
    return f"Waits: no worker can meet its needs ({needs}). Workers have: {there}. Add a larger one, or ask for less."
