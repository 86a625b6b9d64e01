"""``trompe judge``: on this machine, or on a server."""

import sys
from collections.abc import Callable, Collection
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Any, Final

import click
from pydantic import ValidationError

from trompe_client._client import Client
from trompe_client._progress import shown
from trompe_client.cli.connection import out_option, token_option
from trompe_client.cli.following import deliver, follow
from trompe_client.cli.options import flag_of
from trompe_client.cli.output import print_json, say
from trompe_shared.api import (
    JOB_RESULT,
    JUDGEMENT_OPTIONS,
    MANIFEST,
    MANIFEST_PAGE,
    OPTIONS,
    Event,
    JobState,
    JudgementSpec,
    Manifest,
    Progress,
)
from trompe_shared.errors import SpecError
from trompe_shared.faults import faults_of
from trompe_shared.json_option import as_json, json_option

HERE: Final = "trompe.here"
"""Entry points of the server package with the functions that judge without a service."""


@click.command(params=list(map(flag_of, JUDGEMENT_OPTIONS)))
@click.argument("before", required=False)
@click.argument("after", required=False)
@click.option("--label", multiple=True, metavar="NAME_OR_INDEX", help=f"{OPTIONS['label'].help.capitalize()}. *")
@out_option(required=False, help="Folder for the results.")
@click.option(
    "--verify", type=click.Path(path_type=Path, exists=True, dir_okay=False), help="Check a manifest instead."
)
@click.option("--server", envvar="TROMPE_SERVER", metavar="URL", help="Judge on a running server (or TROMPE_SERVER).")
@token_option
@json_option
def judge(
    before: str | None,
    after: str | None,
    out: Path | None,
    verify: Path | None,
    server: str | None,
    token: str | None,
    **options: Any,
) -> None:
    """Judge AFTER, a repaint of BEFORE by anyone: zips, model files, folders with one, or shipped objects.

    On a server also stored objects, and job:ID, the result of a job. Writes judgement.json, the manifest, and
    judgement.html. The same command continues after Ctrl-C. Options marked * can be given several times.
    """
    given = {name: value for name, value in options.items() if value not in (None, ())}
    if verify is not None:
        if before is not None or out is not None or given.keys() - {"renderers"}:
            raise click.UsageError("--verify takes a manifest alone, and --renderer for one that you trust.")
        sys.exit(_verify(verify, given.get("renderers", ())))
    if before is None or after is None or out is None or "label" not in given:
        raise click.UsageError("Give two files, --label and --out: trompe judge BEFORE AFTER --label mug --out DIR")
    if server is None and after.startswith(JOB_RESULT):
        raise click.UsageError(f"{after!r} is the result of a job on a server: add --server, or give its file.")
    spec = JudgementSpec.of(before, after, **given)
    out.mkdir(parents=True, exist_ok=True)
    if server is None:
        _judge_here(spec, out)
    else:
        with Client(server, token=token) as client:
            deliver(follow(client.judge(before, after, **given)), out)


def _judge_here(spec: JudgementSpec, out: Path) -> None:
    from trompe_client._report import judgement_report

    judge_here = _here("judge")
    with shown(True) as show:

        def tell(progress: Progress) -> None:
            show(Event(id=0, time=datetime.now(UTC), state=JobState.running, progress=progress))

        try:
            manifest: Manifest = judge_here(spec, out, tell)
        except KeyboardInterrupt:
            click.echo(f"\nFinished work is kept in {out}. The same command goes on with it.", err=True)
            raise
    say(manifest, lambda: judgement_report(manifest, [out / MANIFEST, out / MANIFEST_PAGE]))
    if all(cell.accuracy is None for cell in manifest.cells):
        raise SpecError("The judgement has no figures; the lines above say why.")


def _here(name: str) -> Callable[..., Any]:
    """A function of the server package. Raises ``ModuleNotFoundError`` without it."""
    (found,) = metadata.entry_points(group=HERE, name=name)
    function: Callable[..., Any] = found.load()
    return function


def _verify(file: Path, trusted: Collection[str]) -> int:
    """Print the faults of a manifest; the exit code. trusted: renderers of it that may run."""
    try:
        manifest = Manifest.model_validate_json(file.read_bytes())
    except ValidationError as error:
        raise SpecError(f"{file} is not a manifest of trompe judge: {next(faults_of(error))}.") from error
    faults = []
    for fault in _here("verify")(manifest, file.parent, trusted):
        faults.append(fault)
        if not as_json():
            click.echo(fault)
    if as_json():
        print_json({"faults": faults}, indent=2)
    elif not faults:
        click.echo("Files, figures and findings are as it says, and random views rendered again have the same classes.")
    return int(bool(faults))
