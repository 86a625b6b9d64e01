"""``trompe attack``: all options of a job, by what they are about."""

from functools import partial
from pathlib import Path
from typing import Any, Final, get_args

import click

from trompe_client._plan import plan_attack
from trompe_client.cli.connection import out_option, server_option, service, token_option
from trompe_client.cli.following import deliver, follow, follow_our_own
from trompe_client.cli.options import Sectioned, SectionOption, tag_option
from trompe_client.cli.output import json_option, say
from trompe_shared.api import (
    VIEWS_PER_PLACE,
    VIEWS_PER_STEP,
    AttackOn,
    JobRequest,
    Loss,
    Needs,
    Optimiser,
    Priority,
    SaliencyScope,
    SunRanges,
    SurrogateModel,
    ViewRanges,
)
from trompe_shared.errors import SpecError

__all__ = ["attack"]


def _default(option: str) -> str:
    """The default of a job's option, in words."""
    return str(JobRequest.model_fields[option].get_default())


def _class(word: str) -> str | int:
    """A class by its index, else by its name."""
    return int(word) if word.isdecimal() else word


def _mask(word: str) -> tuple[str, str]:
    texture, equals, picture = word.partition("=")
    if not (texture and equals and picture):
        raise click.BadParameter(f"{word!r} should be a texture and a picture of its size: albedo.png=mask.png.")
    return texture, picture


_networks = partial(click.option, cls=SectionOption, section="Object and classifiers")
_change = partial(click.option, cls=SectionOption, section="What may change")
_goal = partial(click.option, cls=SectionOption, section="What the classifier should say")
_search = partial(click.option, cls=SectionOption, section="How it is looked for")
_views = partial(click.option, cls=SectionOption, section="Views")

CLASSIFIER: Final = "FILE_OR_NAME"
RANGES: Final = [name for name in ViewRanges.model_fields if name != "light_colours"]


@click.command(cls=Sectioned)
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
@_change(
    "--attack-on",
    type=click.Choice(get_args(AttackOn)),
    help=f"The texture, where the main light stands, or (slightly) the vertices. Default: {_default('attack_on')}.",
)
@_change(
    "--sun",
    multiple=True,
    type=(click.Choice(list(SunRanges.model_fields)), float, float),
    metavar="NAME LO HI",
    help="Of light, where it may stand: azimuth (all around by default), elevation (15 to 88), intensity, ambient "
    "(each view's own). *",
)
@_change(
    "--vertex-budget",
    type=float,
    metavar="SHARE",
    help=f"Of vertices, how far one may move, a share of the object's radius. Default: {_default('vertex_budget')}.",
)
@_change("--epsilon", type=float, metavar="E", help=f"Largest change of a texel, 0..1. Default: {_default('epsilon')}.")
@_change(
    "--epsilon-view",
    type=float,
    metavar="E",
    help="Largest change of a pixel of a view, 0..1 (the paper's view constraint). Default: no limit.",
)
@_change("--tau", type=float, metavar="T", help="Saliency threshold, 0..1. Default: attack all texels.")
@_change(
    "--saliency-scope",
    type=click.Choice(get_args(SaliencyScope)),
    help="What the threshold is a share of: the largest saliency of all views, or of each view, so that all of them "
    f"give pixels. Default: {_default('saliency_scope')}.",
)
@_change("--keep", type=float, metavar="SHARE", help="Attack this share of the texels, the best ones. Default: all.")
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
@_search(
    "--steps",
    type=int,
    metavar="N",
    help=f"At most so many steps; it ends where all views are safely won. Default: {_default('steps')}.",
)
@_search("--optimiser", type=click.Choice(get_args(Optimiser)), help=f"Default: {_default('optimiser')}.")
@_search(
    "--restarts",
    type=int,
    metavar="N",
    help=f"Further runs, which share the steps. Default: {_default('restarts')}.",
)
@_search(
    "--diverse/--no-diverse",
    default=None,
    help="For transfer to other classifiers: show images scaled, shifted and mirrored, and win by as much as possible; "
    "takes all steps. Default: with --ensemble.",
)
@_search(
    "--queries",
    type=int,
    metavar="N",
    help="Scores asked per image and step, an even number; only for a classifier without gradients (.onnx).",
)
@_search(
    "--views-per-step",
    type=int,
    metavar="N",
    help=f"Views that a step looks at. Default: {VIEWS_PER_STEP} of a pool, all of the grid; "
    f"of light {VIEWS_PER_PLACE} that judge nothing.",
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
    default=JobRequest.model_fields["background"].get_default(),
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
@server_option(None)
@token_option
@click.option(
    "--priority",
    type=click.Choice(get_args(Priority)),
    help=f"Its place in the queue. Default: {_default('priority')}.",
)
@click.option("--needs", type=click.Choice(get_args(Needs)), help=f"What to compute on. Default: {_default('needs')}.")
@tag_option("A label of your own, to find the job by. *")
@click.option("--key", metavar="KEY", help="Submit once for this key, however often the command is run.")
@click.option("--detach", is_flag=True, help="Submit only, and say the job's id; needs --server.")
@out_option(required=False, help="Folder for the results; needed unless --detach is given.")
@json_option
def attack(
    server: str | None, token: str | None, key: str | None, detach: bool, out: Path | None, **options: Any
) -> None:
    """Attack OBJECT: a zip, a model file (.obj, .glb, .gltf, .fbx, .ply, .stl), a folder with one, or a stored object.

    An option marked * can be given several times.
    """
    try:
        plan = plan_attack(**_job_options(**options))
        _check_destination(server, detach=detach, out=out)
    except SpecError as error:
        raise click.UsageError(str(error)) from error
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
    with service(server, token) as client:
        job = client.start(plan, key=key)
        if out is None:
            say(job.status, lambda: f"Job {job.id}: follow it by trompe watch {job.id} --server {server}")
            return
        deliver(follow(job) if server else follow_our_own(job), out, source=options["object"])


def _check_destination(server: str | None, *, detach: bool, out: Path | None) -> None:
    """Raises ``SpecError`` unless the results have a place to go to, or stay on a server."""
    if detach and (server is None or out is not None):
        raise SpecError("--detach leaves the job and its results on a server: give --server, and no --out.")
    if not detach and out is None:
        raise SpecError("Say where the results shall go by --out DIR, or submit only, by --detach.")


Named = tuple[str, float, float]
"""A range: what of, and its ends."""


def _ranges(given: tuple[Named, ...]) -> dict[str, tuple[float, float]]:
    return {name: (low, high) for name, low, high in given}


def _job_options(
    *, grid: bool, masks: tuple[tuple[str, str], ...], ranges: tuple[Named, ...], sun: tuple[Named, ...], **options: Any
) -> dict[str, Any]:
    """What was given on the command line, as ``plan_attack`` takes it. Raises ``SpecError``."""
    given = {name: value for name, value in options.items() if value is not None}
    given |= {"masks": dict(masks), "ranges": _ranges(ranges), "sun": _ranges(sun)}
    if grid and given.setdefault("pool", 0):
        raise SpecError("--grid attacks the paper's grid and --pool random views in its place: choose one.")
    return given
