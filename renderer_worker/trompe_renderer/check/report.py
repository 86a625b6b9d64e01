"""``trompe render --check``: the findings line by line."""

import contextlib
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor

import click

from trompe_renderer.check.engine_render import EngineRender
from trompe_renderer.check.questions import Render, check
from trompe_renderer.engines.loading import engine_maker
from trompe_shared.addresses import host_and_port
from trompe_shared.engine import EngineInfo
from trompe_shared.errors import RendererError
from trompe_shared.sailenv_client import SailenvTarget


def check_engine(name: str, settings: Mapping[str, str]) -> bool:
    """Check an engine in this process, print what is found and return whether there is no fault.

    It runs outside the main thread, as in a worker.
    """
    make = engine_maker(name, settings)

    def report() -> bool:
        engine = make()
        return _report(EngineRender(engine), engine.info)

    with ThreadPoolExecutor(1) as thread:
        return thread.submit(report).result()


def check_at(address: str) -> bool:
    """Check the renderer at HOST:PORT likewise. Raises ``RendererError`` if there is none."""
    try:
        host, port = host_and_port(address)
    except ValueError as error:
        raise RendererError(
            f"--check {address}: expected HOST:PORT of a running renderer, or nothing for --engine."
        ) from error
    with contextlib.closing(SailenvTarget(host, port)) as target:
        return _report(target.render, target.engine)


def _report(render: Render, info: EngineInfo) -> bool:
    click.echo(str(info))
    faults = 0
    for finding in check(render, info):
        click.echo(str(finding))
        faults += finding.level == "fault"
    click.echo("No fault." if not faults else f"{faults} fault{'s' * (faults > 1)}.")
    return not faults
