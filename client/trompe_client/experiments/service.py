"""The server, as an experiment needs it: a seam between this package and the client."""

from collections.abc import Iterator
from typing import Protocol

from trompe_client import _core
from trompe_client._client import Client
from trompe_client._errors import NotFound
from trompe_client.experiments.plan import LABEL, File
from trompe_shared.api import Job, JobRequest, Result

__all__ = ["ClientService", "Service"]


class Service(Protocol):
    """Where jobs run. Each method raises ``ClientError``."""

    def store(self, file: File) -> str:
        """Store a file; gives its id. The same bytes are stored once."""
        ...

    def submit(self, request: JobRequest, key: str) -> Job:
        """Submit a job, or find the one that was submitted with the same key."""
        ...

    def job(self, job: str) -> Job:
        """A job's present state."""
        ...

    def jobs(self, experiment: str) -> Iterator[Job]:
        """All jobs of an experiment, newest first."""
        ...

    def result(self, job: str) -> Result:
        """The figures of a job that is done."""
        ...

    def artifact(self, job: str, name: str) -> bytes | None:
        """A file of a job; ``None`` where it has none of that name."""
        ...

    def classes(self, classifier: str) -> list[str] | None:
        """Class names of a stored classifier by its name or id, where known."""
        ...


class ClientService:
    """``Service`` over a ``Client``."""

    def __init__(self, client: Client) -> None:
        self._client = client
        self._classes: dict[str, list[str] | None] = {}

    def store(self, file: File) -> str:
        """See ``Service.store``."""
        if file.kind == "object":
            return self._client.send(_core.upload_object(file.upload)).id
        if file.kind == "classifier":
            return self._client.send(_core.upload_classifier(file.upload)).id
        return self._client.send(_core.upload_background(file.upload)).id

    def submit(self, request: JobRequest, key: str) -> Job:
        """See ``Service.submit``."""
        return self._client.submit(request, key=key).status

    def job(self, job: str) -> Job:
        """See ``Service.job``."""
        return self._client.job(job).status

    def jobs(self, experiment: str) -> Iterator[Job]:
        """See ``Service.jobs``."""
        return (handle.status for handle in self._client.jobs(labels={LABEL: experiment}))

    def result(self, job: str) -> Result:
        """See ``Service.result``."""
        return self._client.send(_core.result(job))

    def artifact(self, job: str, name: str) -> bytes | None:
        """See ``Service.artifact``."""
        try:
            return self._client.send(_core.artifact(job, name))
        except NotFound:
            return None

    def classes(self, classifier: str) -> list[str] | None:
        """See ``Service.classes``."""
        if classifier not in self._classes:
            stored = self._client.classifiers()
            self._classes |= {key: one.classes for one in stored for key in (one.id, one.name)}
        return self._classes.get(classifier)
