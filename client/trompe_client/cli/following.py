"""What several commands do with a job: see it through, deliver what came out."""

from contextlib import suppress
from pathlib import Path

import click

from trompe_client._delivery import ADVERSARIAL, in_the_form_of
from trompe_client._job import JobHandle
from trompe_client._progress import Progress
from trompe_client.cli.output import as_json, console, print_json
from trompe_shared.api import JobState
from trompe_shared.errors import TrompeError

__all__ = ["deliver", "follow", "follow_our_own"]


def follow(job: JobHandle, *, timeout: float | None = None, progress: Progress = True) -> JobHandle:
    """See a job through on a server that outlives us. Ctrl-C leaves it running and says how to come back."""
    try:
        return job.wait(timeout, progress=progress)
    except KeyboardInterrupt:
        click.echo(f"\nJob {job.id} goes on. Come back by: trompe watch {job.id} --server {job.server}", err=True)
        raise


def follow_our_own(job: JobHandle) -> JobHandle:
    """See a job through on a server that ends with this command; so Ctrl-C cancels the job."""
    try:
        return job.wait(progress=True)
    except KeyboardInterrupt:
        with suppress(TrompeError):
            job.cancel()
            click.echo(f"\nJob {job.id} is cancelled.", err=True)
        raise


def deliver(job: JobHandle, out: Path | None, *, source: str | None = None) -> None:
    """Download the results and say them; with ``source``, give the object back in its form. No ``out``: no files."""
    files = job.download(out) if out else []
    if source is not None:
        files = [in_the_form_of(source, file) if file.name == ADVERSARIAL else file for file in files]
    result = job.result()
    if as_json():
        print_json({"job": job.status, "result": result, "files": [str(file) for file in files]}, indent=2)
        return
    from trompe_client._report import result_report

    note = job.status.note if job.state is JobState.not_applicable else None
    screen = console()
    screen.print(result_report(result, note=note))
    if files:
        screen.print("written:", *(f"  {file}" for file in files), sep="\n")
