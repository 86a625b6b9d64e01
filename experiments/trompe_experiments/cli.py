"""``trompe experiment``."""

import shlex
import sys
from collections.abc import Sequence
from pathlib import Path
from time import monotonic
from typing import TYPE_CHECKING, Any

import click

from trompe_client._client import Client
from trompe_client.cli.connection import out_option, server_option, service, token_option, with_client
from trompe_client.cli.output import console, say
from trompe_client.tracking import TRACKERS
from trompe_experiments.about import estimated_seconds, in_words, write_about
from trompe_experiments.design import experiment_file, load_experiment, shipped_experiments
from trompe_experiments.plan import Plan, plan_experiment, word
from trompe_experiments.service import Service
from trompe_shared.api import Job, JudgementSpec
from trompe_shared.comparison import differing_options

if TYPE_CHECKING:
    from trompe_experiments.table import ResultRow


@click.group()
def experiment() -> None:
    """Run a grid of jobs from a file; show, compare and report its results."""


@experiment.command()
@click.argument("file")
@out_option(required=False, help="Folder for the results. Default: experiments/NAME.")
@server_option(None)
@token_option
@click.option("--dry-run", is_flag=True, help="Check the file; print the number of jobs and an estimate of the time.")
@click.option("--retry-failed", is_flag=True, help="Submit failed jobs of an earlier run again.")
@click.option("--track", type=click.Choice(list(TRACKERS)), help="Log each job as a run there.")
def run(
    file: str,
    out: Path | None,
    server: str | None,
    token: str | None,
    dry_run: bool,
    retry_failed: bool,
    track: str | None,
) -> None:
    """Run the experiment of FILE: a .yaml, or the name of a shipped one.

    Run it again to continue a stopped run: only missing jobs are submitted. A file, with the keywords of the SDK:

    \b
        name: mine
        objects: shipped
        base: {classifier: tiny, steps: 20}
        grid: {epsilon: [0.02, 0.05], tau: [null, 0.05]}
        seeds: [0, 1, 2]
    """
    from trompe_experiments.judged import judge_all
    from trompe_experiments.progress import Tracked, experiment_display
    from trompe_experiments.run import run_experiment

    started, plan = monotonic(), plan_experiment(load_experiment(file))
    folder = out or Path("experiments") / plan.experiment.name
    click.echo(_announcement(plan, folder))
    if dry_run:
        return
    try:
        with service(server, token) as client, experiment_display(console(stderr=True)) as display:
            show = display if track is None else Tracked(display, TRACKERS[track])
            rows = run_experiment(plan, Service(client), folder, show=show, retry_failed=retry_failed)
            if plan.experiment.judgement is not None:
                seconds = {row.key: row.seconds for row in rows}
                judge_all(plan, Service(client), folder, seconds=seconds, show=click.echo)
    except KeyboardInterrupt:
        running = f" Submitted jobs continue on {server}." if server else ""
        click.echo(f"\n{folder} keeps what is done; the same command goes on with it.{running}", err=True)
        raise
    command = f"trompe experiment run {file}" + (f" --out {out}" if out else "")
    write_about(folder, command, seconds=monotonic() - started, source=experiment_file(file))
    _conclude(rows, folder)


def _announcement(plan: Plan, folder: Path) -> str:
    jobs = plan.jobs()
    time = in_words(estimated_seconds(row.request for row in jobs.values()))
    rows = f" ({len(plan.rows)} rows, some with the same job)" if len(plan.rows) > len(jobs) else ""
    return f"{plan.experiment.name}: {len(jobs)} jobs{rows}, about {time} if no attack stops early; results in {folder}"


def _conclude(rows: Sequence["ResultRow"], folder: Path) -> None:
    """Print the results; fail if jobs did."""
    from trompe_experiments.terminal import failures, results_table

    console().print(results_table(rows), crop=False)
    failed = failures(rows)
    click.echo(f"written: {folder}/results.csv, predictions.csv. Next: trompe experiment report {folder}")
    if failed:
        raise click.ClickException(f"{len(failed)} rows failed; fix the cause and run again with --retry-failed.")


@experiment.command()
@click.argument("what", metavar="NAME_OR_DIR")
@with_client
def show(client: Client, what: str) -> None:
    """Show the results in a folder, or the jobs of the experiment NAME on a server."""
    from trompe_experiments.table import read_results
    from trompe_experiments.terminal import results_table

    rows = read_results(what) if Path(what).exists() else _on_server(Service(client), what)
    if not rows:
        raise click.ClickException(
            f"No folder {what!r}, and no job of an experiment {what!r} on {client.server}. "
            "`trompe experiment list` lists the shipped experiments."
        )
    say(rows, lambda: results_table(rows))


def _on_server(found: Service, name: str) -> list["ResultRow"]:
    """The attacks of an experiment, oldest first, with their results so far."""
    from trompe_experiments.table import ResultRow, RowId

    rows = []
    jobs = [job for job in found.jobs(name) if not isinstance(job.spec, JudgementSpec)][::-1]
    shown = differing_options([(job.attack.object, job.attack.options()) for job in jobs])
    for job in jobs:
        spec, own = job.attack, job.names
        place = RowId(experiment=name, key=job.id, configuration=_configuration(job, shown))
        told: dict[str, Any] = {"state": job.state.value, "job": job.id, "object": own.get(spec.object, spec.object)}
        if job.state.final and "result.json" in job.artifacts:
            rows.append(ResultRow.of_result(place, found.result(job.id), **told))
        else:
            told["classifier"] = own.get(spec.victim.classifier, spec.victim.classifier)
            said = job.error or f"{job.progress.phase}, {job.progress.fraction:.0%}"
            rows.append(ResultRow.of_spec(place, spec, error=said, **told))
    return rows


def _configuration(job: Job, options: Sequence[str]) -> str:
    """The ``options`` of a job but its seed, stored things by their names."""
    asked = job.attack.options()
    text = ", ".join(f"{option} {word(asked[option])}" for option in options if option != "seed")
    for stored, name in job.names.items():
        text = text.replace(stored, name)
    return text


@experiment.command()
@click.argument("first", type=click.Path(exists=True, path_type=Path), metavar="A")
@click.argument("second", type=click.Path(exists=True, path_type=Path), metavar="B")
def compare(first: Path, second: Path) -> None:
    """Compare two experiments: folders, or results.csv files."""
    from trompe_experiments.terminal import compared, comparison_table

    console().print(comparison_table(compared(first, second)), crop=False)


@experiment.command("list")
def list_() -> None:
    """List the shipped experiments."""
    for name in shipped_experiments():
        click.echo(f"{name:20} {load_experiment(name).description}")


@experiment.command()
@click.argument("folder", metavar="DIR", type=click.Path(exists=True, file_okay=False, path_type=Path))
def report(folder: Path) -> None:
    """Write the experiment in DIR as one HTML file, and its figures as SVG and PNG."""
    from trompe_experiments.report import write_report

    click.echo(f"written: {write_report(folder)}")


@experiment.command()
@click.argument("document", type=click.Path(exists=True, dir_okay=False, path_type=Path))
@click.option("--check", is_flag=True, help="Change nothing; fail if a block or a figure is outdated.")
def fill(document: Path, check: bool) -> None:
    """Fill the blocks of DOCUMENT with figures from their data."""
    from trompe_experiments import documents

    changed = documents.outdated(document) if check else documents.fill(document)
    for line in changed:
        click.echo(line if check else line.replace("is not made", "was not made") + "; now it is")
    if check and changed:
        click.echo(f"Run: trompe experiment fill {document}", err=True)
        sys.exit(1)


@experiment.command()
@out_option(required=True, help="Folder for the results.")
@click.option("--object", "objects", multiple=True, default=("mug", "lamp"), show_default=True, help="Shipped object.")
@click.option("--seeds", default=2, show_default=True, type=click.IntRange(1), help="Number of seeds.")
@click.option("--only", default="", metavar="WORDS", help="Cases whose name contains WORDS.")
@click.option("--retry-failed", is_flag=True, help="Run failed jobs of an earlier run again.")
def stability(out: Path, objects: tuple[str, ...], seeds: int, only: str, retry_failed: bool) -> None:
    """Attack disturbed renderers and networks, in this process. Takes about half an hour."""
    from trompe_experiments.progress import experiment_display
    from trompe_experiments.run import run_experiment
    from trompe_experiments.stability.cases import stability_plan
    from trompe_experiments.stability.service import DisturbedService
    from trompe_server.renderers import local_renderer

    started, plan = monotonic(), stability_plan(objects=objects, seeds=seeds, only=only)
    click.echo(_announcement(plan, out))
    with local_renderer() as target, experiment_display(console(stderr=True)) as show:
        rows = run_experiment(plan, DisturbedService(target), out, show=show, retry_failed=retry_failed)
    asked = "".join(f" --object {name}" for name in objects) + f" --seeds {seeds}"
    asked += f" --only {shlex.quote(only)}" if only else ""
    write_about(out, f"trompe experiment stability --out {out}{asked}", seconds=monotonic() - started)
    _conclude(rows, out)


@experiment.command("export-variants")
@out_option(required=True, help="Folder for the variants.")
@click.option("--object", "names", multiple=True, help="Shipped object; several times. Default: all.")
@click.option(
    "--variants", "per_object", default=2, show_default=True, type=click.IntRange(1), help="Variants of each object."
)
@click.option("--epsilon", default=0.05, show_default=True, type=click.FloatRange(0, 1, min_open=True))
@click.option("--views", default=40, show_default=True, type=click.IntRange(1), help="Pictures of each variant.")
@click.option("--seed", default=0, show_default=True, type=click.IntRange(0))
@server_option(None)
@token_option
def export_variants(out: Path, server: str | None, token: str | None, **asked: Any) -> None:
    """Write adversarial variants of shipped objects: archives, and labelled pictures in train and test folders.

    Variants of an earlier export into the folder are deleted.
    """
    from trompe_experiments.progress import experiment_display
    from trompe_experiments.variants import export_variants as export
    from trompe_server.renderers import local_renderer

    with (
        service(server, token) as client,
        local_renderer() as target,
        experiment_display(console(stderr=True)) as display,
    ):
        rows = export(out, Service(client), target, **asked, show=display)
    click.echo(f"written: objects, pictures and labels.csv in {out}")
    _conclude(rows, out)
