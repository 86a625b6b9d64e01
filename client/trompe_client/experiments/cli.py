"""``trompe experiment``: run, show, compare; report and what else needs the server's packages comes from there."""

from importlib import metadata
from pathlib import Path
from time import monotonic
from typing import TYPE_CHECKING, Final

import click

from trompe_client._client import Client
from trompe_client.cli.connection import out_option, server_option, service, token_option, with_client
from trompe_client.cli.output import console, json_option, say

if TYPE_CHECKING:
    from trompe_client.experiments.plan import Plan
    from trompe_shared.experiment_table import ResultRow

__all__ = ["experiment"]

COMMANDS_GROUP: Final = "trompe.experiment_commands"
"""Entry points of the subcommands that other packages add."""
FOREIGN: Final = {
    "report": "Write an experiment as one HTML file, with its charts, and the charts as SVG and PNG.",
    "export-variants": "Write adversarial variants of objects, as zips and as labelled pictures.",
}


class _Group(click.Group):
    """A group that finds more commands by entry point, and imports them only when they are called."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return sorted({*super().list_commands(ctx), *FOREIGN})

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name not in FOREIGN:
            return super().get_command(ctx, cmd_name)
        found = list(metadata.entry_points(group=COMMANDS_GROUP, name=cmd_name))
        try:
            if not found:
                raise ModuleNotFoundError("no installed package provides it")
            command = found[0].load()
        except ModuleNotFoundError as error:
            raise click.ClickException(
                f"`trompe experiment {cmd_name}` needs the report extra: pip install 'trompe[report]' ({error})"
            ) from error
        assert isinstance(command, click.Command)
        return command

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        own = {name: command.get_short_help_str(100) for name, command in self.commands.items()}
        with formatter.section("Commands"):
            formatter.write_dl(sorted((own | FOREIGN).items()))


@click.group(cls=_Group)
def experiment() -> None:
    """Run a grid of jobs from a file, and look at what came out."""


@experiment.command()
@click.argument("file")
@out_option(required=False, help="Folder for the results. Default: experiments/NAME.")
@server_option(None)
@token_option
@click.option("--dry-run", is_flag=True, help="Check the file; say how many jobs there are and how long it takes.")
@click.option("--retry-failed", is_flag=True, help="Submit jobs that failed in an earlier run once more.")
def run(file: str, out: Path | None, server: str | None, token: str | None, dry_run: bool, retry_failed: bool) -> None:
    """Run the experiment of FILE: a .yaml, or the name of one that comes with Trompe.

    Run it again to go on where it was stopped: only what is missing is submitted.
    """
    from trompe_client.experiments import ClientService, load_experiment, plan_experiment, run_experiment
    from trompe_client.experiments.about import note_how_it_was_made
    from trompe_client.experiments.design import experiment_file
    from trompe_client.experiments.progress import experiment_display
    from trompe_client.experiments.tables import failures, results_table

    started, plan = monotonic(), plan_experiment(load_experiment(file))
    folder = out or Path("experiments") / plan.experiment.name
    click.echo(_announcement(plan, folder))
    if dry_run:
        return
    with service(server, token) as client, experiment_display(console(stderr=True)) as show:
        outcome = run_experiment(plan, ClientService(client), folder, show=show, retry_failed=retry_failed)
    command = f"trompe experiment run {file}" + (f" --out {out}" if out else "")
    note_how_it_was_made(folder, command, seconds=monotonic() - started, source=experiment_file(file))
    console().print(results_table(outcome.rows))
    for line in failures(outcome.failed):
        click.echo(f"failed: {line}", err=True)
    click.echo(f"written: {folder}/results.csv, predictions.csv. Next: trompe experiment report {folder}")
    if outcome.failed:
        raise click.ClickException(
            f"{len(outcome.failed)} rows failed; mend the cause and run again with --retry-failed."
        )


def _announcement(plan: "Plan", folder: Path) -> str:
    from trompe_client.experiments.estimate import estimated_seconds
    from trompe_client.experiments.progress import in_words

    jobs = plan.jobs()
    time = in_words(estimated_seconds(row.request for row in jobs.values()))
    rows = f" ({len(plan.rows)} rows, some the same job)" if len(plan.rows) > len(jobs) else ""
    return f"{plan.experiment.name}: {len(jobs)} jobs{rows}, about {time} on two cores; results in {folder}"


@experiment.command()
@click.argument("what", metavar="NAME_OR_DIR")
@with_client
@json_option
def show(client: Client, what: str) -> None:
    """Show the results in a folder, or the jobs of the experiment NAME on a server."""
    from trompe_client.experiments.tables import read_results, results_table

    rows = read_results(what) if Path(what).exists() else _on_server(client, what)
    if not rows:
        raise click.ClickException(
            f"{client.server} has no job of an experiment {what!r}, and there is no such folder. "
            "`trompe experiment list` lists those that come with Trompe."
        )
    say(rows, lambda: results_table(rows))


def _on_server(client: Client, name: str) -> list["ResultRow"]:
    """The jobs of an experiment, oldest first, with their results as far as there are any."""
    from trompe_client.experiments import ClientService
    from trompe_shared.experiment_table import ResultRow, RowId

    rows, found = [], ClientService(client)
    for job in found.jobs(name):
        place = RowId(experiment=name, key=job.id)
        if job.state.final and "result.json" in job.artifacts:
            rows.append(ResultRow.of_result(place, found.result(job.id), state=job.state.value, job=job.id))
        else:
            said = job.error or f"{job.progress.phase}, {job.progress.fraction:.0%}"
            rows.append(ResultRow.of_spec(place, job.spec, state=job.state.value, job=job.id, error=said))
    return rows[::-1]


@experiment.command()
@click.argument("first", type=click.Path(exists=True, path_type=Path), metavar="A")
@click.argument("second", type=click.Path(exists=True, path_type=Path), metavar="B")
def compare(first: Path, second: Path) -> None:
    """Put two experiments beside each other: folders, or results.csv files."""
    from trompe_client.experiments.tables import compared, comparison_table

    console().print(comparison_table(compared(first, second)))


@experiment.command("list")
def list_() -> None:
    """List the experiments that come with Trompe."""
    from trompe_client.experiments import load_experiment, shipped_experiments

    for name in shipped_experiments():
        click.echo(f"{name:16} {load_experiment(name).description}")
