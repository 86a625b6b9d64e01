"""Commands for jobs: ``trompe jobs``, ``watch``, ``cancel``, ``report``."""

from itertools import islice
from pathlib import Path
from typing import Any

import click

from trompe_client._client import Client
from trompe_client._report import job_table, jobs_table
from trompe_client.cli.connection import out_option, with_client
from trompe_client.cli.following import deliver, follow
from trompe_client.cli.options import ListedByDefault, tag_option
from trompe_client.cli.output import print_json, say
from trompe_shared.api import Job, JobState
from trompe_shared.json_option import as_json

_job = click.argument("job")
_jobs = click.argument("names", metavar="JOB...", nargs=-1, required=True)


@click.group(cls=ListedByDefault)
def jobs() -> None:
    """Jobs: list, show, cancel, retry, delete or download."""


@jobs.command("list")
@click.option("--state", type=click.Choice([state.value for state in JobState]), help="Only jobs in this state.")
@tag_option("Only jobs with this label. *")
@click.option("--object", metavar="ID", help="Only jobs on this object: an id, or the name of a shipped one.")
@click.option("--classifier", metavar="ID", help="Only jobs against this classifier: id, or name of a shipped one.")
@click.option("--limit", type=click.IntRange(1), default=50, show_default=True, help="Number of jobs, newest first.")
@with_client
def list_jobs(client: Client, limit: int, **wanted: Any) -> None:
    """List jobs, newest first."""
    listed = [handle.status for handle in islice(client.jobs(**wanted), limit)]
    say(listed, lambda: jobs_table(listed))


@jobs.command()
@_job
@with_client
def show(client: Client, job: str) -> None:
    """Show the state and the options of JOB."""
    status = client.job(job).status
    say(status, lambda: job_table(status))


@jobs.command()
@_jobs
@with_client
def cancel(client: Client, names: tuple[str, ...]) -> None:
    """Cancel jobs. Ended jobs stay as they are."""
    _say_states([client.job(name).cancel() for name in names])


@jobs.command()
@_jobs
@with_client
def retry(client: Client, names: tuple[str, ...]) -> None:
    """Submit ended jobs again."""
    _say_states([client.job(name).retry().status for name in names])


@jobs.command()
@_jobs
@with_client
def delete(client: Client, names: tuple[str, ...]) -> None:
    """Delete ended jobs with their files."""
    for name in names:
        client.job(name).delete()
    say({"deleted": names}, lambda: "\n".join(f"Job {name}: deleted" for name in names))


@jobs.command()
@_job
@out_option(required=True, help="Folder for the files.")
@click.option("--zip", "as_zip", is_flag=True, help="Download one file, DIR/JOB.zip.")
@with_client
def download(client: Client, job: str, out: Path, as_zip: bool) -> None:
    """Download the files of JOB. Existing files are not downloaded again."""
    handle = client.job(job)
    files = [handle.archive(out / f"{handle.id}.zip")] if as_zip else handle.download(out)
    say({"files": [str(file) for file in files]}, lambda: "\n".join(str(file) for file in files))


@click.command()
@_job
@click.option("--timeout", type=float, metavar="SECONDS", help="Stop watching after this time; the job continues.")
@with_client
def watch(client: Client, job: str, timeout: float | None) -> None:
    """Follow JOB to its end. With --json: one event a line."""
    handle = client.job(job)
    follow(handle, timeout=timeout, progress=print_json if as_json() else True)
    if not as_json():
        click.echo(f"Job {handle.id}: {handle.state.value}. Download it: trompe report {handle.id} --out DIR")


@click.command()
@_job
@out_option(required=False, help="Folder for the results. Default: print the table only.")
@click.option("--html", type=click.Path(path_type=Path, dir_okay=False), metavar="FILE", help="Write one HTML page.")
@with_client
def report(client: Client, job: str, out: Path | None, html: Path | None) -> None:
    """Print the table of JOB and download its results. The HTML page opens without a network."""
    handle = client.job(job)
    if html is not None:
        html.write_text(handle.show().html, encoding="utf-8")
    deliver(handle, out)


def _say_states(found: list[Job]) -> None:
    say(found, lambda: "\n".join(map(_state, found)))


def _state(job: Job) -> str:
    soon = ", stops soon" if job.state is JobState.running else ""
    return f"Job {job.id}: {job.state.value}{soon}"
