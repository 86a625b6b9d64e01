"""``trompe attack``. Its flags are made from ``OPTIONS``."""

import time
from pathlib import Path
from typing import Any, Final, get_args

import click

from trompe_client._plan import Upload, plan_attack
from trompe_client.cli.connection import out_option, server_option, service, token_option
from trompe_client.cli.following import deliver, follow, follow_our_own
from trompe_client.cli.options import Sectioned, flag_of, needs_option, tag_option
from trompe_client.cli.output import say
from trompe_client.tracking import TRACKERS, tracked
from trompe_shared.api import OPTIONS, JobRequest, in_flags
from trompe_shared.errors import SpecError
from trompe_shared.json_option import json_option


def _priority() -> click.Option:
    info = JobRequest.model_fields["priority"]
    words = f"{info.description}; default: {info.default}."
    return click.Option(["--priority"], type=click.Choice(get_args(info.annotation)), help=words.capitalize())


FLAGS: Final = [*map(flag_of, OPTIONS.values()), _priority(), needs_option()]


@click.command(cls=Sectioned, params=[click.Argument(["object"]), *FLAGS])
@server_option(None)
@token_option
@tag_option("Label of your own, to find the job by. *")
@click.option("--key", metavar="KEY", help="Submit once for this key, however often the command runs.")
@click.option("--detach", is_flag=True, help="Submit and print the job's id; needs --server.")
@click.option("--track", type=click.Choice(list(TRACKERS)), help="Log parameters, curves, result and files there.")
@out_option(required=False, help="Folder for the results; required without --detach.")
@json_option
def attack(
    server: str | None,
    token: str | None,
    key: str | None,
    detach: bool,
    track: str | None,
    out: Path | None,
    **options: Any,
) -> None:
    """Attack OBJECT: a zip, a model file (.obj, .glb, .gltf, .fbx, .ply, .stl), a folder with one, or a stored object.

    Options marked * can be given several times.
    """
    try:
        plan = plan_attack(**{name: value for name, value in options.items() if value not in (None, (), {})})
        _check_destination(server, detach=detach, out=out, track=track)
    except SpecError as error:
        raise click.UsageError(in_flags(str(error))) from error
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
    began = time.monotonic()
    with service(server, token) as client:
        job = client.start(plan, key=key)
        start_up = time.monotonic() - began
        if out is None:
            say(job.status, lambda: f"Job {job.id} is submitted. Follow it: trompe watch {job.id} --server {server}")
            return
        with tracked(track, job, out) as log:
            done = follow(job, also=log) if server else follow_our_own(job, also=log)
            source = options["object"] if isinstance(plan.options["object"], Upload) else None
            deliver(done, out, source=source, began=began, start_up=start_up)


def _check_destination(server: str | None, *, detach: bool, out: Path | None, track: str | None) -> None:
    """Raise ``SpecError`` for results without a place, or with two."""
    if detach and (server is None or out is not None):
        raise SpecError("--detach leaves the job and its results on a server: add --server, and leave out --out.")
    if detach and track is not None:
        raise SpecError("--track follows the job: leave out --detach.")
    if not detach and out is None:
        raise SpecError("Add --out DIR for the results, or --detach to submit only.")
