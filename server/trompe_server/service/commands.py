"""Commands of this package for ``trompe``: serve, worker, migrate, demo, doctor."""

import logging
import os
import subprocess
import sys
from difflib import get_close_matches
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import click
from pydantic import ValidationError

from trompe_server.service.doctor import check_all, in_json, in_words
from trompe_server.settings import Settings
from trompe_server.system.log import log_to_stderr
from trompe_shared.addresses import host_and_port
from trompe_shared.errors import SpecError
from trompe_shared.faults import faults_of
from trompe_shared.json_option import as_json, json_option

if TYPE_CHECKING:
    from trompe_server.renderers.discovery import RendererAddresses

logger = logging.getLogger(__name__)

ALIKE: Final = 0.84
"""Likeness to a setting from which a variable counts as a misspelt one: TROMPE_ has other readers, too."""

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
    help="Folder or URL of the files, e.g. s3://bucket (or TROMPE_STORE). Default: the data folder.",
)
_renderer = click.option(
    "--renderer",
    "listed",
    multiple=True,
    metavar="HOST:PORT",
    help="Address of a renderer worker. Several share the work.",
)
_renderers_dns = click.option(
    "--renderers-dns",
    "names",
    multiple=True,
    metavar="NAME:PORT",
    help="DNS name of all renderer workers, resolved repeatedly.",
)
_device = click.option("--device", metavar="DEVICE", help="cpu, cuda or cuda:1 (or TROMPE_DEVICE). Default: cpu.")


_workers = click.option(
    "--workers",
    type=click.IntRange(0, 64),
    help="Attack workers, which share the cores (or TROMPE_WORKERS); 0: `trompe worker` runs the jobs. Default: 1.",
)
_executor = click.option(
    "--executor",
    metavar="NAME",
    help="local, ray://HOST:PORT or ray-local (or TROMPE_EXECUTOR): what runs the jobs. Default: local.",
)


def settings_of(data: Path | None, **others: object) -> Settings:
    """Settings from the environment, overridden by the given options. Raises ``SpecError``."""
    _warn_of_misspelt()
    options = {"data": data and data.absolute(), **others}
    given: dict[str, Any] = {name: value for name, value in options.items() if value is not None}
    try:
        return Settings(**given)
    except ValidationError as error:
        wrong = "; ".join(f"{fault} (TROMPE_{fault.place.partition('.')[0].upper()})" for fault in faults_of(error))
        raise SpecError(
            f"Invalid settings: {wrong}. Correct the option, or the variable of the environment."
        ) from error


def _warn_of_misspelt() -> None:
    """Warn of each variable that is nearly called as a setting."""
    known = [name.upper() for name in Settings.model_fields]
    found = {name.removeprefix("TROMPE_") for name in os.environ if name.startswith("TROMPE_")}
    for name in sorted(found - set(known)):
        for meant in get_close_matches(name, known, n=1, cutoff=ALIKE):
            logger.warning("the variable TROMPE_%s sets nothing; did you mean TROMPE_%s?", name, meant)


@click.command()
@click.option("--host", default="127.0.0.1", show_default=True, help="Address to listen on.")
@click.option("--port", default=8000, show_default=True, type=click.IntRange(0, 65535), help="Port; 0: a free one.")
@_workers
@_executor
@click.option(
    "--renderers",
    type=click.IntRange(0, 64),
    help="Renderer workers, which share the images of each job (or TROMPE_RENDERERS). Default: 1.",
)
@click.option(
    "--engine",
    metavar="NAME",
    help="Engine of these renderer workers, as in `trompe render --engine` (or TROMPE_ENGINE). Default: pyrender.",
)
@click.option("--set", "engine_options", multiple=True, metavar="NAME=VALUE", help="Option of the engine.")
@_renderer
@_renderers_dns
@_device
@data_option
@database_option
@_store
def serve(
    host: str,
    port: int,
    data: Path | None,
    listed: tuple[str, ...],
    names: tuple[str, ...],
    engine_options: tuple[str, ...],
    **options: str | int | None,
) -> None:
    """Run the service: REST API, attack workers and renderer workers, with one data folder.

    Name renderer workers elsewhere by --renderer or --renderers-dns; --renderers 0 starts none here. They may have
    other engines: jobs name theirs, and those that name none use the first renderer's.
    """
    from trompe_server.service.serve import run_service

    log_to_stderr()
    settings = settings_of(data, engine_options=engine_options or None, **options)
    run_service(settings, _renderers_at(listed, names), host=host, port=port)


@click.command()
@data_option
@database_option
@_store
@_renderer
@_renderers_dns
@_device
@_workers
@_executor
def worker(data: Path | None, listed: tuple[str, ...], names: tuple[str, ...], **options: str | int | None) -> None:
    """Run the jobs of a database, without the API: in processes of this machine, or on a Ray cluster.

    A second `trompe worker` on the same database waits until the first one stops or dies. --executor ray://HOST:PORT
    needs the cluster extra. TROMPE_METRICS_PORT serves the workers' Prometheus metrics at that port.
    """
    from trompe_server.service.dispatch import run_worker

    if not listed and not names:
        raise click.UsageError("Name the renderer workers by --renderer HOST:PORT or --renderers-dns NAME:PORT.")
    log_to_stderr()
    run_worker(settings_of(data, **options), _renderers_at(listed, names))


@click.command()
@data_option
@database_option
def migrate(data: Path | None, database: str | None) -> None:
    """Create or upgrade the tables in the database."""
    from trompe_server.service.dispatch import prepare_data

    log_to_stderr()
    prepare_data(settings_of(data, database=database))
    click.echo("the database is up to date")


def _renderers_at(listed: tuple[str, ...], names: tuple[str, ...]) -> "RendererAddresses":
    from trompe_server.renderers.discovery import RendererAddresses

    return RendererAddresses(tuple(_address(each) for each in listed), tuple(_address(each) for each in names))


def _address(text: str) -> tuple[str, int]:
    try:
        return host_and_port(text)
    except ValueError as error:
        raise click.BadParameter(str(error), param_hint="--renderer or --renderers-dns") from error


@click.command()
@click.option("--out", required=True, type=click.Path(path_type=Path, file_okay=False), help="Folder for the result.")
def demo(out: Path) -> None:
    """Attack the shipped classifier with the shipped mug."""
    attack = ["attack", "mug", "--label", "mug", "--classifier", "tiny", "--steps", "100", "--out", str(out)]
    sys.exit(subprocess.run([sys.executable, "-m", "trompe_client.cli", *attack], check=False).returncode)


@click.command()
@data_option
@database_option
@_store
@_device
@json_option
def doctor(data: Path | None, **options: str | None) -> None:
    """Check this machine and print remedies."""
    findings = []
    for finding in check_all(settings_of(data, **options)):
        findings.append(finding)
        if not as_json():
            click.echo(in_words(finding))
    if as_json():
        click.echo(in_json(findings))
    sys.exit(0 if all(finding.ok for finding in findings) else 1)
