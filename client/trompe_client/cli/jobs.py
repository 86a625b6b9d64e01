"""Commands about jobs: ``trompe jobs``, ``watch``, ``cancel``, ``report``."""

from itertools import islice
from pathlib import Path

import click

from trompe_client._client import Client
from trompe_client._report import job_table, jobs_table
from trompe_client.cli.connection import out_option, with_client
from trompe_client.cli.following import deliver, follow
from trompe_client.cli.grouping import ListedByDefault
from trompe_client.cli.options import tag_option
from trompe_client.cli.output import as_json, json_option, print_json, say
from trompe_shared.api import Job, JobState

__all__ = ["cancel", "jobs", "report", "watch"]

_job = click.argument("job")
_jobs = click.argument("names", metavar="JOB...", nargs=-1, required=True)


@click.group(cls=ListedByDefault)
def jobs() -> None:
    """Jobs: list them, show, cancel, retry, delete or download some."""


@jobs.command("list")
@click.option("--state", type=click.Choice([state.value for state in JobState]), help="Only jobs in this state.")
@tag_option("Only jobs with this label. *")
@click.option("--object", "object_", metavar="ID", help="Only jobs on this object; of a shipped one, its name.")
@click.option("--classifier", metavar="ID", help="Only jobs against this one; of a shipped one, its name.")
@click.option(
    "--limit", type=click.IntRange(min=1), default=50, show_default=True, help="At most so many, newest first."
)
@json_option
@with_client
def list_jobs(
    client: Client,
    state: str | None,
    labels: dict[str, str],
    object_: str | None,
    classifier: str | None,
    limit: int,
) -> None:
    """List jobs, newest first."""
    found = client.jobs(state=state, labels=labels, object=object_, classifier=classifier)
    listed = [handle.status for handle in islice(found, limit)]
    say(listed, lambda: jobs_table(listed))


@jobs.command()
@_job
@json_option
@with_client
def show(client: Client, job: str) -> None:
    """Show how JOB stands, and what was asked for."""
    status = client.job(job).status
    say(status, lambda: job_table(status))


@jobs.command("cancel")
@_jobs
@json_option
@with_client
def cancel_jobs(client: Client, names: tuple[str, ...]) -> None:
    """Cancel jobs; those that have ended stay as they are."""
    _say_states([client.job(name).cancel() for name in names])


@jobs.command()
@_jobs
@json_option
@with_client
def retry(client: Client, names: tuple[str, ...]) -> None:
    """Submit jobs that have ended anew."""
    _say_states([client.job(name).retry().status for name in names])


@jobs.command()
@_jobs
@json_option
@with_client
def delete(client: Client, names: tuple[str, ...]) -> None:
    """Delete jobs that have ended, with their files."""
    for name in names:
        client.job(name).delete()
    say({"deleted": names}, lambda: "\n".join(f"Job {name}: deleted" for name in names))


@jobs.command()
@_job
@out_option(required=True, help="Folder for the files.")
@click.option("--zip", "as_zip", is_flag=True, help="Bring them as one file, DIR/JOB.zip.")
@json_option
@with_client
def download(client: Client, job: str, out: Path, as_zip: bool) -> None:
    """Download the files of JOB; what is there already is not brought again."""
    handle = client.job(job)
    files = [handle.archive(out / f"{handle.id}.zip")] if as_zip else handle.download(out)
    say({"files": [str(file) for file in files]}, lambda: "\n".join(str(file) for file in files))


@click.command()
@_job
@json_option
@with_client
def cancel(client: Client, job: str) -> None:
    """Cancel JOB."""
    _say_states([client.job(job).cancel()])


@click.command()
@_job
@click.option("--timeout", type=float, metavar="SECONDS", help="Look no longer than this; the job goes on.")
@json_option
@with_client
def watch(client: Client, job: str, timeout: float | None) -> None:
    """Follow JOB to its end. With --json: its events, one a line."""
    handle = client.job(job)
    follow(handle, timeout=timeout, progress=print_json if as_json() else True)
    if not as_json():
        click.echo(f"Job {handle.id}: {handle.state.value}. Fetch it by: trompe report {handle.id} --out DIR")


@click.command()
@_job
@out_option(required=False, help="Folder for the results. Default: say the figures only.")
@json_option
@with_client
def report(client: Client, job: str, out: Path | None) -> None:
    """Print the table of JOB, and download its results."""
    deliver(client.job(job), out)


def _say_states(found: list[Job]) -> None:
    """How jobs stand after something was asked of them."""
    say(found, lambda: "\n".join(map(_state, found)))


def _state(job: Job) -> str:
    soon = ", to stop within moments" if job.state is JobState.running else ""
    return f"Job {job.id}: {job.state.value}{soon}"
