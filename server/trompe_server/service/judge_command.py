"""``trompe judge``."""

import shutil
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import click
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn
from rich.table import Table

from trompe_shared.api import AS_RENDERED, OPTIONS, Manifest
from trompe_shared.errors import SpecError

if TYPE_CHECKING:
    from trompe_server.judgement.request import JudgeRequest
    from trompe_server.judgement.work import OnWork, Work

__all__ = ["judge"]

MANIFEST, PAGE, KEPT = "judgement.json", "judgement.html", ".judging"

WIDTH: Final = 160
"""Columns of a table into a pipe."""

INTERVAL: Final = 10.0
"""Seconds between two lines of progress into a pipe."""


def _help(keyword: str) -> str:
    """The words of a job's option."""
    words = OPTIONS[keyword].help
    return words[0].upper() + words[1:]


@click.command()
@click.argument("before", required=False)
@click.argument("after", required=False)
@click.option("--label", multiple=True, metavar="NAME_OR_INDEX", help=f"{_help('label')}. *")
@click.option("--suite", metavar="NAME", help="Views, networks and renderers by name: standard-1 (docs/benchmark.md).")
@click.option("--network", "networks", multiple=True, metavar="FILE_OR_NAME", help="A network. Default: tiny. *")
@click.option(
    "--renderer",
    "renderers",
    multiple=True,
    metavar="NAME",
    help="An engine, or HOST:PORT of a running renderer. Default: pyrender. *",
)
@click.option("--views", type=int, help="Random views and lights. Default: 60.")
@click.option("--seed", type=int, help="Of the views. Default: 0.")
@click.option("--epsilon", type=float, help="The budget that AFTER is said to keep, 0..1.")
@click.option("--distance", type=float, help=f"{_help('distance')}.")
@click.option("--elevation", type=(float, float), metavar="LO HI", help=f"{_help('elevation')}.")
@click.option("--background", metavar="COLOUR", help="white, black or '#rrggbb'. Default: white.")
@click.option("--out", type=click.Path(path_type=Path, file_okay=False), metavar="DIR", help="Folder for the results.")
@click.option(
    "--verify", type=click.Path(path_type=Path, exists=True, dir_okay=False), help="Check a manifest instead."
)
def judge(before: str | None, after: str | None, out: Path | None, verify: Path | None, **options: Any) -> None:
    """Judge AFTER, a repaint of BEFORE by anyone: zips, model files, folders with one, or shipped objects.

    Writes judgement.json, the manifest, and judgement.html. The same command continues after Ctrl-C. Options marked *
    can be given several times.
    """
    given = {name: value for name, value in options.items() if value not in (None, ())}
    if verify is not None:
        if before is not None or out is not None or given:
            raise click.UsageError("--verify takes a manifest alone.")
        sys.exit(_verify(verify))
    if before is None or after is None or out is None or "label" not in given:
        raise click.UsageError("Give two files, --label and --out: trompe judge BEFORE AFTER --label mug --out DIR")
    request = _request(before, after, given)
    out.mkdir(parents=True, exist_ok=True)
    try:
        manifest = _judge(request, out)
    except KeyboardInterrupt:
        click.echo(f"\nFinished work is kept in {out}. The same command goes on with it.", err=True)
        raise
    _say(manifest, out)
    sys.exit(not any(cell.accuracy for cell in manifest.cells))


def _request(before: str, after: str, given: dict[str, Any]) -> "JudgeRequest":
    from trompe_server.judgement.request import JudgeRequest

    suite = given.pop("suite", None)
    if suite is None:
        return JudgeRequest(before, after, **given)
    for name in {"views", "seed"} & given.keys():
        raise click.UsageError(f"The suite {suite} fixes --{name}: leave it out.")
    own = {"networks": (), "renderers": ()} | given
    return JudgeRequest(before, after, **own).in_suite(suite)


def _judge(request: "JudgeRequest", out: Path) -> Manifest:
    from trompe_server.judgement.judge_files import judge_files
    from trompe_server.judgement.manifest import manifest_of
    from trompe_server.judgement.pictures import judgement_pictures
    from trompe_server.pages.judgement import judgement_page

    began = time.monotonic()
    with _shown() as show:
        judged = judge_files(request, out, kept=out / KEPT, on_work=show)
    manifest = manifest_of(judged, request, seconds=time.monotonic() - began)
    (out / PAGE).write_text(judgement_page(manifest, judgement_pictures(judged)), encoding="utf-8")
    (out / MANIFEST).write_text(manifest.model_dump_json(indent=1), encoding="utf-8")
    shutil.rmtree(out / KEPT, ignore_errors=True)
    return manifest


def _verify(file: Path) -> int:
    """Print the faults of a manifest; the exit code."""
    import numpy as np
    from pydantic import ValidationError

    from trompe_server.judgement.verify import VIEWS_AGAIN, verify

    try:
        manifest = Manifest.model_validate_json(file.read_bytes())
    except ValidationError as error:
        raise SpecError(f"{file} is not a manifest of trompe judge ({error.error_count()} faults).") from error
    faults = 0
    for fault in verify(manifest, file.parent, generator=np.random.default_rng()):
        click.echo(fault)
        faults += 1
    if not faults:
        again = min(VIEWS_AGAIN, len(manifest.views))
        click.echo(f"The files are those of the manifest, and {again} views rendered again have the same classes.")
    return int(faults > 0)


@contextmanager
def _shown() -> "Iterator[OnWork]":
    """Shows the work: a bar on a terminal, else a line every ``INTERVAL``."""
    console = Console(stderr=True, markup=False, highlight=False, soft_wrap=True)
    if not console.is_terminal:
        yield _Lines(console).show
        return
    with Progress(TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(), console=console) as bar:
        task = bar.add_task("opening", total=1.0)
        yield lambda work: bar.update(task, completed=work.done, description=_words(work))


class _Lines:
    def __init__(self, console: Console) -> None:
        self._console, self._said = console, 0.0

    def show(self, work: "Work") -> None:
        """Print a line if it is due."""
        if time.monotonic() > self._said + INTERVAL:
            self._said = time.monotonic()
            self._console.print(f"{work.done:4.0%}  {_words(work)}")


def _words(work: "Work") -> str:
    minutes, seconds = divmod(round(work.seconds_left), 60)
    return f"{work.what}, {minutes}:{seconds:02} left"


def _say(manifest: Manifest, out: Path) -> None:
    from trompe_server.pages.judgement import shares_in_words

    table = Table("network", "renderer", "before", "after", "A_drop (95 %)")
    for cell in manifest.cells:
        if cell.pipeline == AS_RENDERED:
            table.add_row(cell.network, cell.renderer, *shares_in_words(cell.accuracy))
    console = Console(markup=False, highlight=False, soft_wrap=True)
    console.width = console.width if console.is_terminal else WIDTH
    console.print(table)
    for finding in manifest.findings:
        console.print(f"- {finding.text}")
    console.print(f"written: {out / MANIFEST}, {out / PAGE}")
