"""The command ``trompe``. Commands of the other packages are found by entry point and imported only when called."""

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass
from functools import partial
from importlib import metadata
from itertools import groupby, islice
from pathlib import Path
from typing import Any, Final, TypeVar, get_args

import click
from rich.console import Console

from trompe_client._client import DEFAULT_SERVER, Client
from trompe_client._delivery import ADVERSARIAL, in_the_form_of
from trompe_client._embedded import embedded_server
from trompe_client._job import JobHandle
from trompe_client._plan import AttackPlan, plan_attack
from trompe_client._report import classifiers_table, jobs_table, objects_table, result_report
from trompe_shared.api import JobSpec, JobState, Loss, Optimiser, SurrogateModel, ViewRanges
from trompe_shared.errors import SpecError, TrompeError

__all__ = ["main"]

COMMANDS_GROUP: Final = "trompe.commands"
INTERRUPTED: Final = 130

F = TypeVar("F", bound=Callable[..., None])


@dataclass(frozen=True)
class _Extension:
    """A command of another package: the extra that installs what it needs, and its line in ``trompe --help``."""

    extra: str
    help: str


EXTENSIONS: Final = {
    "serve": _Extension("server", "Run the service: API, attack worker and renderer."),
    "worker": _Extension("server", "Run one more attack worker."),
    "demo": _Extension("server", "Attack an object that comes with Trompe, and show the result."),
    "doctor": _Extension("server", "Check this machine: GL, torch, folders, ports."),
    "render": _Extension("renderer", "Run a renderer worker (SAILenv's protocol)."),
}


class _Trompe(click.Group):
    """A group that finds more commands by entry point, and turns errors into a paragraph and an exit code."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return sorted({*super().list_commands(ctx), *EXTENSIONS, *metadata.entry_points(group=COMMANDS_GROUP).names})

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name in self.commands or cmd_name not in self.list_commands(ctx):
            return super().get_command(ctx, cmd_name)
        return _load_extension(cmd_name)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """As click's own, but without importing the commands of other packages."""
        own = {name: command.get_short_help_str(100) for name, command in self.commands.items()}
        foreign = {name: extension.help for name, extension in EXTENSIONS.items()}
        with formatter.section("Commands"):
            formatter.write_dl([(name, (foreign | own).get(name, "")) for name in self.list_commands(ctx)])

    def invoke(self, ctx: click.Context) -> Any:
        try:
            return super().invoke(ctx)
        except KeyboardInterrupt:
            click.echo("Interrupted.", err=True)
            ctx.exit(INTERRUPTED)
        except BrokenPipeError:
            raise
        except ModuleNotFoundError as error:  # commands import what they need when they are called
            if ctx.invoked_subcommand not in EXTENSIONS:
                raise
            raise _missing_extra(ctx.invoked_subcommand, error) from error
        except (TrompeError, OSError) as error:
            request_id = getattr(error, "request_id", None)
            click.echo(f"trompe: {error}" + (f" (request {request_id})" if request_id else ""), err=True)
            ctx.exit(1)


def _load_extension(name: str) -> click.Command:
    """Import a command of another package. Raises ``ClickException`` when what it needs is not installed."""
    found = list(metadata.entry_points(group=COMMANDS_GROUP, name=name))
    try:
        if not found:
            raise ModuleNotFoundError(f"no installed package provides the command {name!r}")
        command = found[0].load()
    except ModuleNotFoundError as error:
        raise _missing_extra(name, error) from error
    assert isinstance(command, click.Command)
    return command


def _missing_extra(name: str, error: ModuleNotFoundError) -> click.ClickException:
    """The error that names the extra to install."""
    if name not in EXTENSIONS:
        return click.ClickException(f"`trompe {name}` cannot be loaded: {error}.")
    extra = EXTENSIONS[name].extra
    return click.ClickException(f"`trompe {name}` needs the {extra} extra: pip install 'trompe[{extra}]' ({error})")


def _default(option: str) -> str:
    """The default of a job's option, in words."""
    return str(JobSpec.model_fields[option].get_default())


@click.group(cls=_Trompe, context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 120})
@click.version_option(package_name="trompe")
def main() -> None:
    """Craft adversarial 3D objects: repaint a texture so that people see the same object and a classifier does not."""


class _Option(click.Option):
    """An option that ``--help`` lists in a section."""

    def __init__(self, *declarations: Any, section: str, **attributes: Any) -> None:
        super().__init__(*declarations, **attributes)
        self.section = section


class _Sectioned(click.Command):
    """A command with so many options that ``--help`` lists them by section."""

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """As click's own, section by section."""
        options = (each for each in self.get_params(ctx) if isinstance(each, click.Option))
        for title, section in groupby(options, lambda option: getattr(option, "section", "Server and results")):
            with formatter.section(title):
                formatter.write_dl([record for option in section if (record := option.get_help_record(ctx))])


def _class(word: str) -> str | int:
    """A class by its index, else by its name."""
    return int(word) if word.isdecimal() else word


def _mask(word: str) -> tuple[str, str]:
    texture, equals, picture = word.partition("=")
    if not (texture and equals and picture):
        raise click.BadParameter(f"{word!r} should be a texture and a picture of its size: albedo.png=mask.png.")
    return texture, picture


def _server_option(*, required: bool) -> Callable[[F], F]:
    without = DEFAULT_SERVER if required else None
    text = f"Address of a running server (or TROMPE_SERVER). Default: {without or 'start one for this command'}."
    return click.option("--server", envvar="TROMPE_SERVER", metavar="URL", default=without, help=text)


_out_option = click.option(
    "--out",
    required=True,
    type=click.Path(file_okay=False, path_type=Path),
    metavar="DIR",
    help="Folder for the results.",
)

_networks = partial(click.option, cls=_Option, section="Object and classifiers")
_change = partial(click.option, cls=_Option, section="What may change")
_goal = partial(click.option, cls=_Option, section="What the classifier should say")
_search = partial(click.option, cls=_Option, section="How it is looked for")
_views = partial(click.option, cls=_Option, section="Views")

CLASSIFIER: Final = "FILE_OR_NAME"
RANGES: Final = [name for name in ViewRanges.model_fields if name != "light_colours"]
GRID: Final = ("azimuths", "elevations")


@main.command(cls=_Sectioned)
@click.argument("object", metavar="OBJECT")
@_networks("--label", required=True, type=_class, metavar="NAME_OR_INDEX", help="The object's true class.")
@_networks(
    "--classifier",
    default=_default("classifier"),
    show_default=True,
    metavar=CLASSIFIER,
    help="Victim: a .pt2, TorchScript (.pt) or .onnx file, or a name.",
)
@_networks("--ensemble", multiple=True, metavar=CLASSIFIER, help="Another victim, attacked together with it. *")
@_networks("--judge", "judges", multiple=True, metavar=CLASSIFIER, help="Another classifier, which only judges. *")
@_change("--epsilon", type=float, metavar="E", help=f"Largest change of a texel, 0..1. Default: {_default('epsilon')}.")
@_change(
    "--epsilon-view",
    type=float,
    metavar="E",
    help="Largest change of a pixel of a view, 0..1 (the paper's view constraint). Default: no limit.",
)
@_change("--tau", type=float, metavar="T", help="Saliency threshold, 0..1. Default: attack all texels.")
@_change("--keep", type=float, metavar="SHARE", help="Attack this share of the texels, the most salient. Default: all.")
@_change(
    "--material", "materials", multiple=True, metavar="NAME", help="Attack this material only. Default: all of them. *"
)
@_change(
    "--mask",
    "masks",
    multiple=True,
    type=_mask,
    metavar="TEXTURE=FILE",
    help="Picture of a texture's size, white where the texture may change. *",
)
@_goal(
    "--target",
    "target_label",
    type=_class,
    metavar="NAME_OR_INDEX",
    help="The class to be taken for. Default: any but the label.",
)
@_goal(
    "--top-k",
    type=int,
    metavar="K",
    help=f"The true class must leave the K best ones. Default: {_default('top_k')}.",
)
@_goal("--loss", type=click.Choice(get_args(Loss)), help=f"Default: {_default('loss')}.")
@_search("--alpha", type=float, metavar="A", help="Mean step, 0..1. Default: 0.01, or epsilon / 5 if less.")
@_search("--steps", type=int, metavar="N", help=f"Steps of the attack. Default: {_default('steps')}.")
@_search("--optimiser", type=click.Choice(get_args(Optimiser)), help=f"Default: {_default('optimiser')}.")
@_search(
    "--restarts",
    type=int,
    metavar="N",
    help=f"Further runs, which share the steps. Default: {_default('restarts')}.",
)
@_search(
    "--queries",
    type=int,
    metavar="N",
    help="Scores asked per image and step, an even number; only for a classifier without gradients (.onnx).",
)
@_search("--surrogate", type=click.Choice(get_args(SurrogateModel)), help=f"Default: {_default('surrogate')}.")
@_search("--seed", type=int, metavar="S", help=f"Same seed, same bytes. Default: {_default('seed')}.")
@_views(
    "--distance",
    type=float,
    metavar="D",
    help="Camera's, metres. Default: a shipped object's own, or to fit.",
)
@_views(
    "--elevation",
    type=float,
    nargs=2,
    metavar="LO HI",
    help="Range of the camera's, degrees. Default: a shipped object's own, else 0 50.",
)
@_views(
    "--background",
    multiple=True,
    default=JobSpec.model_fields["background"].get_default(),
    show_default=True,
    metavar="COLOUR_OR_FILE",
    help="Behind the object: white, black, #rrggbb or a picture; each view draws one of several. *",
)
@_views(
    "--pool",
    type=int,
    metavar="N",
    help=f"Attack N random cameras and lights; 0 for the paper's grid. Default: {_default('pool')}.",
)
@_views(
    "--range",
    "ranges",
    multiple=True,
    type=(click.Choice(RANGES), float, float),
    metavar="NAME LO HI",
    help=f"What random views are drawn from: {', '.join(RANGES)}; angles in degrees. *",
)
@_views(
    "--held-out",
    type=int,
    metavar="N",
    help=f"Random views that the attack does not see, to judge it on. Default: {_default('held_out')}.",
)
@_views(
    "--grid",
    is_flag=True,
    help=f"Attack the paper's grid of views, {_default('azimuths')} azimuths by {_default('elevations')} elevations, "
    "in place of random ones.",
)
@_views("--azimuths", type=int, metavar="N", help=f"Columns of the grid. Default: {_default('azimuths')}.")
@_views("--elevations", type=int, metavar="N", help=f"Rows of the grid. Default: {_default('elevations')}.")
@_server_option(required=False)
@_out_option
def attack(server: str | None, out: Path, **options: Any) -> None:
    """Attack OBJECT: a zip, a folder with an .obj, an .obj file, or the name of a stored object.

    An option marked * can be given several times.
    """
    try:
        plan = plan_attack(**_job_options(**options))
    except SpecError as error:
        raise click.UsageError(str(error)) from error
    out.mkdir(parents=True, exist_ok=True)
    with _service(server) as client:
        job = _attack(client, plan, server)
        _deliver(job, out, source=options["object"])


def _job_options(
    *, grid: bool, masks: tuple[tuple[str, str], ...], ranges: tuple[tuple[str, float, float], ...], **options: Any
) -> dict[str, Any]:
    """What was given on the command line, as ``plan_attack`` takes it. Raises ``SpecError``."""
    given = {name: value for name, value in options.items() if value is not None}
    given |= {"masks": dict(masks), "ranges": {name: (low, high) for name, low, high in ranges}}
    if grid and given.setdefault("pool", 0):
        raise SpecError("--grid attacks the paper's grid and --pool random views in its place: choose one.")
    if given.get("pool", JobSpec.model_fields["pool"].get_default()) and any(name in given for name in GRID):
        raise SpecError("--azimuths and --elevations shape the paper's grid of views: add --grid.")
    return given


def _attack(client: Client, plan: AttackPlan, server: str | None) -> JobHandle:
    """Start a job and see it through. Ctrl-C cancels it only when its server would end with this command anyway."""
    job = client.start(plan)
    if server is not None:
        return _watch(job, server)
    try:
        return job.wait(progress=True)
    except KeyboardInterrupt:
        with suppress(TrompeError):
            job.cancel()
            click.echo(f"\nJob {job.id} is cancelled.", err=True)
        raise


def _watch(job: JobHandle, server: str) -> JobHandle:
    """See a job through on a server that outlives us."""
    try:
        return job.wait(progress=True)
    except KeyboardInterrupt:
        click.echo(f"\nJob {job.id} goes on. Come back by: trompe watch {job.id} --server {server}", err=True)
        raise


@contextmanager
def _service(server: str | None) -> Iterator[Client]:
    """A client of the server at ``server``, or of one that runs as long as the block."""
    with nullcontext(server) if server else _embedded_with_spinner() as url, Client(url) as client:
        yield client


@contextmanager
def _embedded_with_spinner() -> Iterator[str]:
    status = _console(stderr=True).status("starting the service for this command")
    status.start()
    try:
        with embedded_server() as url:
            status.stop()
            yield url
    finally:
        status.stop()


def _deliver(job: JobHandle, out: Path, *, source: str | None = None) -> None:
    """Download the results and print the table; with ``source``, give the object back in its form."""
    files = job.download(out)
    if source is not None:
        files = [in_the_form_of(source, file) if file == out / ADVERSARIAL else file for file in files]
    console = _console()
    note = job.status.note if job.state is JobState.not_applicable else None
    console.print(result_report(job.result(), note=note))
    console.print("written:", *(f"  {file}" for file in files), sep="\n")


def _console(*, stderr: bool = False) -> Console:
    """A console that takes the server's words literally, and that is wide where nobody's terminal limits it."""
    console = Console(stderr=stderr, markup=False, highlight=False, emoji=False)
    return (
        console
        if console.is_terminal
        else Console(stderr=stderr, markup=False, highlight=False, emoji=False, width=160)
    )


@main.command()
@click.argument("job")
@_server_option(required=True)
def watch(job: str, server: str) -> None:
    """Follow JOB to its end."""
    with Client(server) as client:
        handle = _watch(client.job(job), server)
        click.echo(f"Job {handle.id}: {handle.state.value}. Fetch it by: trompe report {handle.id} --out DIR")


@main.command()
@click.option("--state", type=click.Choice([state.value for state in JobState]), help="Only jobs in this state.")
@click.option(
    "--limit", type=click.IntRange(min=1), default=50, show_default=True, help="At most so many, newest first."
)
@_server_option(required=True)
def jobs(state: str | None, limit: int, server: str) -> None:
    """List jobs."""
    with Client(server) as client:
        _console().print(jobs_table(list(islice(client.jobs(state=state), limit))))


@main.command()
@click.argument("job")
@_server_option(required=True)
def cancel(job: str, server: str) -> None:
    """Cancel JOB."""
    with Client(server) as client:
        status = client.job(job).cancel()
        click.echo(
            f"Job {status.id}: {status.state.value}" + ("" if status.state.final else ", to stop within moments")
        )


@main.command()
@click.argument("job")
@_out_option
@_server_option(required=True)
def report(job: str, out: Path, server: str) -> None:
    """Download the results of JOB and print its table."""
    with Client(server) as client:
        _deliver(client.job(job), out)


@main.command()
@_server_option(required=True)
def objects(server: str) -> None:
    """List stored objects."""
    with Client(server) as client:
        _console().print(objects_table(client.objects()))


@main.command()
@_server_option(required=True)
def classifiers(server: str) -> None:
    """List stored classifiers."""
    with Client(server) as client:
        _console().print(classifiers_table(client.classifiers()))


if __name__ == "__main__":
    sys.exit(main())
