"""Jobs in the record, submitted and claimed by hand."""

from typing import Any, Final

from trompe_server.queue.claims import Claim, Claims, Ending
from trompe_server.queue.store import JobStore
from trompe_shared.api import JobRequest, JobState

DONE: Final = Ending(JobState.succeeded, note="done")


def request(**options: Any) -> JobRequest:
    return JobRequest.of(**{"object": "mug", "label": "mug"} | options)


def create(store: JobStore, **options: Any) -> str:
    return store.create(request(**options))[0].id


def claims_of(store: JobStore) -> Claims:
    return Claims(store.engine)


def claim(store: JobStore, worker: str = "w") -> Claim:
    """Claim the next job, whatever it needs."""
    claims = claims_of(store)
    found = claims.claim(claims.upcoming()[0], worker)
    assert found is not None
    return found
