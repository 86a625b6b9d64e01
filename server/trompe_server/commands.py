"""The commands that this package adds to ``trompe``: serve, worker, demo, doctor."""

import functools
import logging
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import ParamSpec, TypeVar

import click

from trompe_server.doctor import check_all
from trompe_server.settings import Settings
from trompe_shared.errors import TrompeError

__all__ = ["demo", "doctor", "serve", "worker"]

P = ParamSpec("P")
R = TypeVar("R")

_data = click.option(
    "--data", type=click.Path(path_type=Path, file_okay=False), help="Folder of data (or TROMPE_DATA)."
)
_device = click.option("--device", metavar="DEVICE", help="cpu, cuda or cuda:1 (or TROMPE_DEVICE). Default: cpu.")


def _for_people(command: Callable[P, R]) -> Callable[P, R]:
    """Show errors as one sentence instead of a traceback."""

    @functools.wraps(command)
    def run(*args: P.args, **kwargs: P.kwargs) -> R:
        try:
            return command(*args, **kwargs)
        except TrompeError as error:
            raise click.ClickException(str(error)) from error

    return run


def _settings(data: Path | None, **others: object) -> Settings:
    """The settings of the environment, and those that were given as options."""
    given = {"data": data and data.absolute(), **others}
    return Settings.model_validate(
        Settings().model_dump() | {k: value for k, value in given.items() if value is not None}
    )


def _log_to_stderr() -> None:
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(levelname)s %(name)s: %(message)s")
    for chatty in ("httpx", "PIL", "OpenGL"):
        logging.getLogger(chatty).setLevel(logging.WARNING)


def _announce(line: str) -> None:
    click.echo(line)
    sys.stdout.flush()


@click.command()
@click.option("--host", default="127.0.0.1", show_default=True, help="Address to listen on.")
@click.option(
    "--port", default=8000, show_default=True, type=click.IntRange(0, 65535), help="Port; 0 takes a free one."
)
@click.option(
    "--renderers",
    type=click.IntRange(1, 64),
    help="Renderer workers, which share each job's images (or TROMPE_RENDERERS). Default: 1.",
)
@_device
@_data
@_for_people
def serve(host: str, port: int, renderers: int | None, device: str | None, data: Path | None) -> None:
    """Run the service: REST API, one attack worker, its renderer workers, one folder of data."""
    from trompe_server.serving import run_service

    _log_to_stderr()
    run_service(_settings(data, device=device, renderers=renderers), host=host, port=port, announce=_announce)


@click.command()
@_data
@click.option(
    "--renderer",
    "renderers",
    required=True,
    multiple=True,
    metavar="HOST:PORT",
    help="A renderer worker that shows the objects. Several share the work.",
)
@_device
@_for_people
def worker(data: Path | None, renderers: tuple[str, ...], device: str | None) -> None:
    """Run an attack worker, which takes jobs of a data folder one after the other."""
    from trompe_server.jobs.worker import run_worker

    _log_to_stderr()
    run_worker(_settings(data, device=device), [_address(renderer) for renderer in renderers], announce=_announce)


def _address(text: str) -> tuple[str, int]:
    host, _, port = text.rpartition(":")
    if not host or not port.isdecimal():
        raise click.BadParameter(f"{text!r} is not HOST:PORT, such as 127.0.0.1:8085", param_hint="--renderer")
    return host, int(port)


@click.command()
@click.option("--out", required=True, type=click.Path(path_type=Path, file_okay=False), help="Folder of the result.")
def demo(out: Path) -> None:
    """Attack the shipped mug against the shipped classifier, from object to result."""
    attack = ["attack", "mug", "--label", "mug", "--classifier", "tiny", "--steps", "100", "--out", str(out)]
    sys.exit(subprocess.run([sys.executable, "-m", "trompe_client.cli", *attack], check=False).returncode)


@click.command()
@_data
def doctor(data: Path | None) -> None:
    """Check that this machine can do the work, and say how to mend what it cannot."""
    findings = check_all(_settings(data))
    for finding in findings:
        click.echo(f"{'ok  ' if finding.ok else 'FAIL'} {finding.what}: {finding.words}")
    sys.exit(0 if all(finding.ok for finding in findings) else 1)
