"""The server's part in an experiment: files, jobs, results."""

from collections.abc import Iterator

from trompe_client import _core
from trompe_client._client import Client
from trompe_client._errors import NotFound
from trompe_client._plan import Upload
from trompe_experiments.plan import LABEL
from trompe_shared.api import Job, JobRequest, JudgementRequest, Manifest, Result


class Service:
    """Runs jobs on a Trompe server through the SDK. Every method raises ``ClientError``."""

    def __init__(self, client: Client) -> None:
        self._client = client
        self._classes: dict[str, list[str] | None] = {}

    def store(self, upload: Upload) -> str:
        """Store a file; returns its id. Equal bytes are stored once."""
        return self._client.send(_core.store(upload, upload.kind)).id

    def submit(self, request: JobRequest, key: str) -> Job:
        """Submit a job, or find the job submitted with the same key."""
        return self._client.submit(request, key=key).status

    def judge(self, request: JudgementRequest, *, key: str) -> Manifest:
        """Judge, or find the judgement submitted with the same key. Raises ``JobFailed``."""
        return self._client.submit(request, key=key).wait().manifest()

    def job(self, job: str) -> Job:
        """Current state of a job."""
        return self._client.job(job).status

    def jobs(self, experiment: str) -> Iterator[Job]:
        """All jobs of an experiment, newest first."""
        return (handle.status for handle in self._client.jobs(labels={LABEL: experiment}))

    def result(self, job: str) -> Result:
        """Result of a finished job."""
        return self._client.send(_core.result(job))

    def artifact(self, job: str, name: str) -> bytes | None:
        """A file of a job; ``None`` if it has none of that name."""
        try:
            return self._client.send(_core.artifact(job, name))
        except NotFound:
            return None

    def classes(self, classifier: str) -> list[str] | None:
        """Class names of a stored classifier by its name or id, if known."""
        if classifier not in self._classes:
            stored = self._client.classifiers()
            self._classes |= {key: one.classes for one in stored for key in (one.id, one.name)}
        return self._classes.get(classifier)
