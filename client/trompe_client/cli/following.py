"""Follow a job to its end and deliver its results."""

import os
import tempfile
import time
import zipfile
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Final

import click

from trompe_client._job import JobHandle
from trompe_client._progress import Progress, Show, shown
from trompe_client._transfer import check_inside
from trompe_client.cli.output import console, print_json, say
from trompe_shared.api import ADVERSARIAL, Event, JobState, JudgementSpec, in_flags
from trompe_shared.errors import TrompeError
from trompe_shared.json_option import as_json
from trompe_shared.local_files import is_split

RESULT: Final = "result.json"


def follow(
    job: JobHandle, *, timeout: float | None = None, progress: Progress = True, also: Show | None = None
) -> JobHandle:
    """Follow a job on a running server. Ctrl-C leaves the job running and prints how to follow it again.

    ``also`` gets each event too.
    """
    try:
        return _wait(job, timeout, progress, also)
    except KeyboardInterrupt:
        click.echo(f"\nJob {job.id} continues. Follow it: trompe watch {job.id} --server {job.server}", err=True)
        raise


def _wait(job: JobHandle, timeout: float | None, progress: Progress, also: Show | None) -> JobHandle:
    """Wait for the end. Messages for people name flags."""

    def each(event: Event) -> None:
        if also is not None:
            also(event)
        words = event.message and in_flags(event.message)
        show(event.model_copy(update={"message": words}) if progress is True else event)

    with shown(progress) as show:
        return job.wait(timeout, progress=each)


def follow_our_own(job: JobHandle, *, also: Show | None = None) -> JobHandle:
    """Follow a job on the embedded server, which ends with the command: Ctrl-C cancels the job."""
    try:
        return _wait(job, None, True, also)
    except KeyboardInterrupt:
        with suppress(TrompeError):
            job.cancel()
            click.echo(f"\nJob {job.id} is cancelled.", err=True)
        raise


def deliver(
    job: JobHandle, out: Path | None, *, source: str | None = None, began: float | None = None, start_up: float = 0.0
) -> None:
    """Print the results and download them to ``out``, if any, with the object in the form of ``source``.

    began: when the command began, on the monotonic clock; ``start_up``: its seconds until the job was submitted.
    """
    earlier = (out / RESULT).read_bytes() if out and (out / RESULT).is_file() else None
    files = job.download(out) if out else []
    if isinstance(job.status.spec, JudgementSpec):
        from trompe_client._report import judgement_report

        manifest = job.manifest()
        say({"job": job.status, "manifest": manifest}, lambda: judgement_report(manifest, files))
        return
    if source is not None:
        files = [_in_the_form_of(source, file) for file in files]
    result = job.result()
    if out and earlier is not None:
        _tell_of_others(earlier, out, files)
    if as_json():
        print_json({"job": job.status, "result": result, "files": [str(file) for file in files]}, indent=2)
        return
    from trompe_client._report import result_report, spent

    note = job.status.note if job.state is JobState.not_applicable else None
    screen = console()
    wall = None if began is None else time.monotonic() - began
    seconds = spent(result, job.status, start_up=start_up, wall=wall)
    screen.print(result_report(result, note=note, seconds=seconds), crop=False)
    if files:
        screen.print("written:", *(f"  {file}" for file in files), sep="\n")


def _in_the_form_of(source: str, file: Path) -> Path:
    """Unpack the zip with the repainted object if ``source`` is a folder or a model with files beside it.

    Returns the folder; any other file stays as it is.
    """
    given = Path(source)
    if not (file.name.endswith(f"{ADVERSARIAL}.zip") and (given.is_dir() or is_split(given))):
        return file
    folder = file.with_suffix("")
    try:
        _unpack(file, folder)
    except OSError as error:
        click.echo(f"{file} stays packed: {folder} cannot be written ({error.strerror or error}).", err=True)
        return file
    file.unlink()
    return folder


def _unpack(archive: Path, folder: Path) -> None:
    """Unpack a zip into ``folder``, each file at once, in place of one of its name."""
    with tempfile.TemporaryDirectory(dir=archive.parent, prefix=".unpacking-") as scratch:
        with zipfile.ZipFile(archive) as members:
            check_inside(folder, members.namelist())
            members.extractall(scratch)
        for file in filter(Path.is_file, Path(scratch).rglob("*")):
            place = folder / file.relative_to(scratch)
            place.parent.mkdir(parents=True, exist_ok=True)
            os.replace(file, place)


def _tell_of_others(earlier: bytes, out: Path, files: Sequence[Path]) -> None:
    """Name what another result, ``earlier``, left beside the new ``files`` in ``out``."""
    others = sorted(
        {each.name for each in out.iterdir() if not each.name.startswith(".")} - {each.name for each in files}
    )
    if others and (out / RESULT).read_bytes() != earlier:
        click.echo(f"{out} has files of an earlier result, too: {', '.join(others)}", err=True)
