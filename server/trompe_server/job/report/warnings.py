"""Warnings in ``result.json``: what limits the reading of the figures, and what to do with the options of this job."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Final

from trompe_server.job.report.data import ReportData
from trompe_server.job.setup import JobSetup
from trompe_server.judging.metrics import drop_warning, reach_warning, texels_altered, transfer_gap
from trompe_server.judging.visibility import paint_warnings
from trompe_server.surrogate.fidelity import MAX_ERROR, MIN_EXPLAINED
from trompe_shared.api import MOST_VIEWS, Accuracy, FooledAs, JobSpec

POOR_VIEW: Final = 3.0 / 255
NAMED_VIEWS: Final = 5
LARGE_GAP: Final = 0.1
"""Transfer gap above which a warning is given."""

STEEP: Final = 0.1
"""Difference of the slope of predicted changes from 1 above which a warning tells its direction."""

LOUD: Final = 2.0
"""Noise of a renderer, root mean square in 1/255, above which a warning advises more samples."""

MORE_VIEWS: Final = 240
"""A pool size that reaches unseen views for most objects."""

HALF_LEVEL: Final = 0.5 / 255
"""Smallest change of a texel that its texture, saved in 8 bits, shows."""

NAMED: Final = 5
"""Neighbours named in a warning."""


def warnings_of(data: ReportData, seen: Sequence[ReportData]) -> Iterator[str]:
    """All warnings: of the headline's renderer, and of surrogates in all renderers ``seen``."""
    target = data.target

    def in_each(check: Callable[[ReportData], Iterator[str]]) -> Iterator[str]:
        engines = [each.renderer.engine for each in seen]
        for each in seen:
            prefix = f"In {each.renderer.engine.named(engines)}: " if len(seen) > 1 else ""
            yield from (prefix + warning for warning in check(each))

    if target.a_before > 0 and (warning := drop_warning(target)):
        yield warning
    yield from paint_warnings(data.setup.obj)
    yield from in_each(_fidelity)
    if data.painted is not None and texels_altered(data.setup.obj.textures, data.painted.textures) == 0:
        yield f"No texel was altered: {_why_unaltered(data.spec)}"
    yield from in_each(_transfer)
    if data.after is not None and (
        warning := reach_warning(target, data.held_out, stronger=_stronger(data), wider=_wider(data))
    ):
        yield warning.rstrip()
    yield from in_each(_poor_views)
    for each in seen:
        yield from _noise(each)


def _noise(data: ReportData) -> Iterator[str]:
    engine, measured = data.renderer.engine, None if data.calibration is None else 255 * data.calibration.noise
    if not engine.deterministic and measured != 0:
        by = f" of {measured:.1f}/255 (RMS)" if measured else ""
        yield (
            f"{engine} is not deterministic: pictures of the same view differ by random noise{by}. Only pictures of "
            "held-out views have noise that the attack has not seen."
            + (" If they are fooled less, let the renderer take more samples." if measured and measured > LOUD else "")
        )


def _stronger(data: ReportData) -> str:
    """Advice for a larger effect: the options that limited this attack."""
    paint = data.spec.paint
    reached = data.spec.search.steps * data.spec.alpha >= paint.epsilon
    limits = {
        "a larger `alpha`": not reached,
        "a larger `epsilon`": reached and paint.epsilon < 1,
        "`loss: margin`": data.spec.goal.loss != "margin",
        "more `steps`": _took_all_steps(data),
        "a larger `epsilon_view`": paint.epsilon_view is not None,
        "a smaller `tau`": bool(paint.tau),
        "a larger `keep`": paint.keep is not None,
        "more `materials`": bool(paint.materials),
        "larger `masks`": bool(paint.masks),
    }
    return _try([advice for advice, limited in limits.items() if limited], "or")


def _wider(data: ReportData) -> str:
    """Advice for an effect on other views."""
    spec = data.spec
    if spec.views.grid:
        given = [f"`{keyword}`" for keyword in ("grid", "azimuths", "elevations") if keyword in spec.changed()]
        return f"Attack random views instead: leave out {_listed(given, 'and')}."
    pool = min(max(MORE_VIEWS, 2 * spec.views.pool), MOST_VIEWS)
    more = {f"`pool: {pool}`": pool > spec.views.pool, "more `steps`": _took_all_steps(data)}
    return _try([advice for advice, possible in more.items() if possible], "and")


def _took_all_steps(data: ReportData) -> bool:
    """Whether the attack might have taken more steps."""
    return data.spent.steps >= data.spec.search.steps


def _try(advice: Sequence[str], word: str) -> str:
    return f"Try {_listed(advice, word)}." if advice else ""


def _listed(words: Sequence[str], word: str) -> str:
    *others, last = words
    return f"{', '.join(others)} {word} {last}" if others else last


def _fidelity(data: ReportData) -> Iterator[str]:
    calibration = data.calibration
    if calibration is None or calibration.model == "diffuse" or calibration.fidelity.good_enough:
        return
    mean, automatic = calibration.fidelity.mean(), data.spec.search.surrogate == "auto"
    told = (
        "`trompe render --check` tells whether the renderer keeps the conventions; if it does, look for blur or noise."
    )
    yield (
        f"The surrogate is outside its tolerance: mean error {mean['error'] * 255:.1f}/255 "
        f"(at most {MAX_ERROR * 255:.1f}), {mean['explained']:.0%} of a random repaint's effect explained "
        f"(at least {MIN_EXPLAINED:.0%}). {_direction(mean['slope'])}{told if automatic else 'Try `surrogate: auto`.'}"
    )


def _direction(slope: float) -> str:
    """Whether the surrogate promises too much; ``slope``: true change per predicted change."""
    if abs(slope - 1) < STEEP or slope <= 0:
        return ""
    return (
        f"It predicts {1 / slope:.1f} times the true change, so it promises too {'much' if slope < 1 else 'little'}. "
    )


def _transfer(data: ReportData) -> Iterator[str]:
    """Warning of an attack with less effect than predicted."""
    gap = transfer_gap(data.predicted, data.target)
    if gap is not None and gap > LARGE_GAP:
        automatic = data.spec.search.surrogate == "auto"
        remedy = "result.json has its fidelity view by view." if automatic else "Try `surrogate: auto`."
        yield f"The surrogate predicted more than the target kept: its A_drop is larger by {gap:.2f}. {remedy}"


def _why_unaltered(spec: JobSpec) -> str:
    if spec.alpha * spec.search.steps < HALF_LEVEL:
        return (
            f"`alpha` times `steps`, {spec.alpha * spec.search.steps:.2g}, is less than half an 8-bit level (1/255), "
            "to which textures are rounded. Try a larger `alpha` or more `steps`."
        )
    if spec.paint.tau is not None:
        advice = ["a smaller `tau`"] * (spec.paint.tau > 0) + ["`keep` in its place"] * (spec.paint.keep is None)
        return (
            "no change through the pixels that `tau` selects fools more views than the unpainted object. "
            f"{_try(advice, 'or')}"
        )
    if spec.victim.queries is not None:
        return "the classifier's scores do not change with its images. Try more `queries`."
    remedy = "Export it without its softmax" if spec.goal.loss == "margin" else "Try `loss: margin`"
    return f"the classifier's gradient is zero on every view, as behind a saturated softmax, or not finite. {remedy}."


def _poor_views(data: ReportData) -> Iterator[str]:
    """Views on which the surrogate is far off, on the unpainted object or on the change."""
    if data.surrogate is None:
        return
    fits = {index: fit for index, fit in enumerate(data.fits) if fit is not None}
    errors = dict(enumerate(data.surrogate.clean_errors())) | {index: fit.error for index, fit in fits.items()}
    if off := {index: 255 * error for index, error in errors.items() if error > POOR_VIEW}:
        yield (
            f"The surrogate is off by more than {255 * POOR_VIEW:.0f}/255 on views {_named(data.setup, off, '{:.1f}')}."
        )
    if unlike := {index: 1 - fit.explained for index, fit in fits.items() if fit.poor}:
        yield (
            f"The surrogate did not predict more than {1 - MIN_EXPLAINED:.0%} of the change on views "
            f"{_named(data.setup, unlike, '{:.0%}')}."
        )


def _named(setup: JobSetup, poor: Mapping[int, float], figure: str) -> str:
    """Views by number and camera with their figures, the largest first; at most ``NAMED_VIEWS``."""
    named = []
    for index in sorted(poor, key=lambda index: -poor[index])[:NAMED_VIEWS]:
        camera = setup.views[index].camera
        where = f"azimuth {camera.azimuth:.0f}, elevation {camera.elevation:.0f}"
        named.append(f"{index} ({where}): {figure.format(poor[index])}")
    more = f", and {len(poor) - NAMED_VIEWS} more" if len(poor) > NAMED_VIEWS else ""
    return "; ".join(named) + more


def neighbour_warning(found: Sequence[FooledAs], target: Accuracy, held_out: Accuracy | None) -> str | None:
    """Warning that held-out views, or else own ones, became neighbours of the object's class; ``None`` if none did."""
    for views, judged in (("held_out", held_out), ("own", target)):
        near = [each for each in found if each.neighbour and getattr(each, views)]
        if not near or judged is None or judged.a_drop is None or judged.a_drop_with_neighbours is None:
            continue
        everything, part = (sum(getattr(each, views) for each in some) for some in (found, near))
        names = [(each.name or "").split(",")[0] for each in near]
        named = ", ".join(names[:NAMED] + (["..."] if len(names) > NAMED else []))
        return (
            f"Of {everything} fooled {views.replace('_', '-')} views, {part} became a neighbour of the object's class "
            f"({named}): A_drop is {judged.a_drop:.2f}, or {judged.a_drop_with_neighbours:.2f} if all neighbours count "
            "as the object. If such a class is right too, give it as one more label."
        )
    return None
