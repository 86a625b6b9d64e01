"""The commands that this package adds to ``trompe``: serve, worker, migrate, demo, doctor."""

import functools
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, ParamSpec, TypeVar

import click

from trompe_server.doctor import check_all, in_json, in_words
from trompe_server.log import log_to_stderr
from trompe_server.settings import Settings
from trompe_shared.errors import TrompeError

if TYPE_CHECKING:
    from trompe_server.jobs.renderers import Renderers

__all__ = [
    "data_option",
    "database_option",
    "demo",
    "doctor",
    "for_people",
    "migrate",
    "serve",
    "settings_of",
    "worker",
]

P = ParamSpec("P")
R = TypeVar("R")

data_option = click.option(
    "--data", type=click.Path(path_type=Path, file_okay=False), help="Folder of data (or TROMPE_DATA)."
)
database_option = click.option(
    "--database",
    metavar="URL",
    help="sqlite:///FILE or postgresql://... (or TROMPE_DATABASE). Default: in the data folder.",
)
_store = click.option(
    "--store",
    metavar="URL",
    help="Folder or URL, such as s3://bucket, of files (or TROMPE_STORE). Default: the data folder.",
)
_renderer = click.option(
    "--renderer",
    "listed",
    multiple=True,
    metavar="HOST:PORT",
    help="A renderer worker that shows the objects. Several share the work.",
)
_renderers_dns = click.option(
    "--renderers-dns",
    "names",
    multiple=True,
    metavar="NAME:PORT",
    help="A name that the DNS resolves to the addresses of all renderer workers, looked up again and again.",
)
_device = click.option("--device", metavar="DEVICE", help="cpu, cuda or cuda:1 (or TROMPE_DEVICE). Default: cpu.")


def for_people(command: Callable[P, R]) -> Callable[P, R]:
    """Show errors as one sentence instead of a traceback."""

    @functools.wraps(command)
    def run(*args: P.args, **kwargs: P.kwargs) -> R:
        try:
            return command(*args, **kwargs)
        except TrompeError as error:
            raise click.ClickException(str(error)) from error

    return run


def settings_of(data: Path | None, **others: object) -> Settings:
    """The settings of the environment, and those that were given as options."""
    given = {"data": data and data.absolute(), **others}
    return Settings.model_validate(
        Settings().model_dump() | {k: value for k, value in given.items() if value is not None}
    )


def _announce(line: str) -> None:
    click.echo(line)
    sys.stdout.flush()


@click.command()
@click.option("--host", default="127.0.0.1", show_default=True, help="Address to listen on.")
@click.option(
    "--port", default=8000, show_default=True, type=click.IntRange(0, 65535), help="Port; 0 takes a free one."
)
@click.option(
    "--workers",
    type=click.IntRange(0, 64),
    help="Attack workers, which share the cores (or TROMPE_WORKERS); 0 where all are elsewhere. Default: 1.",
)
@click.option(
    "--renderers",
    type=click.IntRange(0, 64),
    help="Renderer workers, which share each job's images (or TROMPE_RENDERERS). Default: 1.",
)
@_renderer
@_renderers_dns
@_device
@data_option
@database_option
@_store
@for_people
def serve(
    host: str,
    port: int,
    data: Path | None,
    listed: tuple[str, ...],
    names: tuple[str, ...],
    **options: str | int | None,
) -> None:
    """Run the service: REST API, its attack workers and renderer workers, one folder of data.

    Renderer workers that run elsewhere are named by --renderer or --renderers-dns; --renderers 0 starts none here.
    """
    from trompe_server.serving import run_service

    log_to_stderr()
    run_service(settings_of(data, **options), _renderers_at(listed, names), host=host, port=port, announce=_announce)


@click.command()
@data_option
@database_option
@_store
@_renderer
@_renderers_dns
@_device
@for_people
def worker(data: Path | None, listed: tuple[str, ...], names: tuple[str, ...], **options: str | None) -> None:
    """Run an attack worker, which takes one job after the other, of any machine that shares database and store."""
    from trompe_server.jobs.worker import run_worker

    if not listed and not names:
        raise click.UsageError("Say where the renderer workers are: --renderer HOST:PORT or --renderers-dns NAME:PORT.")
    log_to_stderr()
    run_worker(settings_of(data, **options), _renderers_at(listed, names), announce=_announce)


@click.command()
@data_option
@database_option
@for_people
def migrate(data: Path | None, database: str | None) -> None:
    """Make the database, or bring it up to date: once, before anything works with it."""
    from trompe_server.jobs.worker import prepare_data

    log_to_stderr()
    prepare_data(settings_of(data, database=database))
    _announce("the database is up to date")


def _renderers_at(listed: tuple[str, ...], names: tuple[str, ...]) -> "Renderers":
    from trompe_server.jobs.renderers import Renderers

    return Renderers(tuple(_address(each) for each in listed), tuple(_address(each) for each in names))


def _address(text: str) -> tuple[str, int]:
    host, _, port = text.rpartition(":")
    if not host or not port.isdecimal():
        raise click.BadParameter(
            f"{text!r} is not HOST:PORT, such as 127.0.0.1:8085", param_hint="--renderer or --renderers-dns"
        )
    return host, int(port)


@click.command()
@click.option("--out", required=True, type=click.Path(path_type=Path, file_okay=False), help="Folder of the result.")
def demo(out: Path) -> None:
    """Attack the shipped mug against the shipped classifier, from object to result."""
    attack = ["attack", "mug", "--label", "mug", "--classifier", "tiny", "--steps", "100", "--out", str(out)]
    sys.exit(subprocess.run([sys.executable, "-m", "trompe_client.cli", *attack], check=False).returncode)


@click.command()
@data_option
@database_option
@_store
@_device
@click.option("--json", "as_json", is_flag=True, help="Answer in JSON.")
def doctor(data: Path | None, as_json: bool, **options: str | None) -> None:
    """Check that this machine can do the work, and say how to mend what it cannot."""
    findings = []
    for finding in check_all(settings_of(data, **options)):
        findings.append(finding)
        if not as_json:
            _announce(in_words(finding))
    if as_json:
        _announce(in_json(findings))
    sys.exit(0 if all(finding.ok for finding in findings) else 1)
