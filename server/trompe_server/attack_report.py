"""The report of a job: ``result.json``, the pictures, and the repainted object."""

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image

from trompe_server.attack.metrics import (
    accuracy,
    drop_warning,
    max_view_change,
    mean_texel_change,
    predicted_classes,
    reach_warning,
    share_beyond,
    softmax,
    texels_altered,
    transfer_gap,
    view_predictions,
)
from trompe_server.attack.perceptual import object_pixels, perceived_change, total_variation
from trompe_server.classifiers import Classifier
from trompe_server.formats import repaint_limited, write_glb
from trompe_server.job_files import Spent
from trompe_server.pipeline import VIEWS_AFTER, VIEWS_BEFORE, Artifacts
from trompe_server.reports import (
    Verdict,
    contact_sheet,
    difference_strip,
    prediction_histogram,
    representative,
    saliency_object_sheet,
    saliency_sheet,
    saliency_texture_sheet,
    texture_sheet,
)
from trompe_server.scene import Scene
from trompe_server.surrogate import Surrogate, behind, textures_of
from trompe_server.surrogate.calibration import Calibration
from trompe_server.surrogate.fidelity import MAX_ERROR, MIN_EXPLAINED, ViewFit, compare_views
from trompe_shared.api import Accuracy, JobSpec, Judgement, Result, ViewFidelity, ViewPrediction
from trompe_shared.errors import ObjectError
from trompe_shared.geometry import Camera
from trompe_shared.object3d import Object3D, encode_png

__all__ = ["Beyond", "Evidence", "public_files", "saliency_views"]

Images = Mapping[str, NDArray[np.uint8]]
"""Target images (views, H, W, 3) of the attack's ``own`` views and of the ``held_out`` ones."""

SHEET_VIEWS: Final = 12
SALIENCY_VIEWS: Final = 6
DIFFERENCE_VIEWS: Final = 4
POOR_VIEW: Final = 3.0 / 255
NAMED_VIEWS: Final = 5
LARGE_GAP: Final = 0.1
"""A transfer gap that is told."""

MORE_VIEWS: Final = 240
"""A pool that reaches unseen views, for most objects."""


@dataclass(frozen=True)
class Beyond:
    """What an attack on something else than the texture tells of itself.

    words: what it changed, for titles. figures: fields of ``Result``. pictures: files by name. predicted: what its
    model shows of the own views after the attack, (views, H, W, 3); ``None`` where it has no model.
    """

    words: str
    figures: Mapping[str, Any]
    pictures: Mapping[str, NDArray[np.uint8]] = field(default_factory=dict)
    predicted: NDArray[np.uint8] | None = None


@dataclass(frozen=True)
class Evidence:
    """All that the report is written from. What belongs to the attack is ``None`` where there was none (n.a.)."""

    spec: JobSpec
    scene: Scene
    before: Images
    after: Images | None
    maps: NDArray[np.float32] | None
    """Saliency of the own views (views, H, W), by the job's scope; this and what is made of it: ``None`` without
    gradients."""
    spent: Spent
    seconds: Mapping[str, float]
    painted: Object3D | None = None
    """The object as the attack left it; ``None`` also where it left the object alone."""
    scores: Mapping[str, NDArray[np.float32]] | None = None
    """Saliency accumulated per texel (H, W)."""
    hot: NDArray[np.uint8] | None = None
    """The target's images, of ``saliency_views``, of the object painted with ``scores`` as heat."""
    surrogate: Surrogate | None = None
    calibration: Calibration | None = None
    beyond: Beyond | None = None
    """``None`` where the texture was attacked."""

    @property
    def repainted(self) -> Object3D | None:
        """The object after an attack on its texture."""
        return self.painted if self.beyond is None else None

    @cached_property
    def logits_before(self) -> Mapping[str, NDArray[np.float32]]:
        """The attacked classifier's logits by set of views."""
        return {name: self.scene.classifier.predict(images) for name, images in self.before.items()}

    @cached_property
    def logits_after(self) -> Mapping[str, NDArray[np.float32]] | None:
        """The same, of the repainted object."""
        if self.after is None:
            return None
        return {name: self.scene.classifier.predict(images) for name, images in self.after.items()}

    @cached_property
    def fits(self) -> Sequence[ViewFit | None]:
        """How well the surrogate predicted each own view and what the attack changed there; empty where it could not be
        seen."""
        if self.surrogate is None or self.repainted is None or self.after is None:
            return ()
        clean, images = self.before["own"], self.after["own"]
        return compare_views(self.surrogate, self.scene.obj, clean, self.repainted, images)


def public_files(evidence: Evidence, artifacts: Artifacts, *, warnings: Sequence[str]) -> tuple[str, ...]:
    """Write everything that is for the user; returns the names of the files, with those of the target's images."""
    files = _pictures(evidence)
    if evidence.painted is not None:
        # The form that it came in is written by repainting the original, which would keep its shape.
        original = evidence.scene.original if evidence.beyond is None else None
        made, refused = _models(evidence.painted, original)
        files, warnings = files | made, (*warnings, *refused)
    files["result.json"] = _result(evidence, warnings).model_dump_json(indent=1).encode()
    for name, data in files.items():
        artifacts.write(name, data)
    images = [VIEWS_BEFORE, VIEWS_AFTER] if evidence.after is not None else [VIEWS_BEFORE]
    return tuple(sorted([*files, *(f"{name}.npz" for name in images)]))


def _models(painted: Object3D, original: tuple[bytes, str] | None) -> tuple[dict[str, bytes], tuple[str, ...]]:
    """The painted object as SAILenv's zip, as GLB and in the form that it came in; and why that could not be made."""
    files = {"adversarial.zip": painted.to_zip(), "adversarial.glb": write_glb(painted)}
    if original is None:
        return files, ()
    data, name = original
    try:
        same = repaint_limited(data, painted, name=name)
    except ObjectError as error:
        return files, (f"The object could not be written in the form that it came in ({name}): {error}",)
    return files | {f"adversarial_{_plain(Path(name).stem)}{same.ending}": same.data}, ()


def _plain(name: str) -> str:
    """A name that an artifact can have."""
    return re.sub(r"[^A-Za-z0-9_.\-]", "_", name)[:100]


def _result(evidence: Evidence, warnings: Sequence[str]) -> Result:
    spec, scene = evidence.spec, evidence.scene
    target, held_out = _accuracy(evidence, "own"), _accuracy(evidence, "held_out") if scene.held_out else None
    surrogate = _surrogate_accuracy(evidence)
    painted, after = evidence.repainted, evidence.logits_after or {}
    budget = {} if spec.attack_on == "texture" else {"epsilon": 0.0, "alpha": 0.0}
    return Result(
        spec=spec,
        object=scene.object_name,
        label=scene.label,
        label_name=scene.class_name(scene.label) if scene.classifier.classes else None,
        classifier=scene.classifier.name,
        ensemble=[member.name for member in scene.members[1:]],
        **(spec.model_dump(include={"epsilon", "alpha", "tau", "seed"}) | budget),
        steps=evidence.spent.steps,
        image_size=scene.size,
        surrogate=surrogate,
        target=target,
        held_out=held_out,
        transfer_gap=transfer_gap(surrogate, target),
        judges=[_judgement(judge, evidence) for judge in scene.judges],
        **(_calibration_fields(evidence) if evidence.beyond is None else evidence.beyond.figures),
        texels_altered=texels_altered(scene.obj.textures, painted.textures) if painted else None,
        mean_texel_change=mean_texel_change(scene.obj.textures, painted.textures) if painted else None,
        **_view_changes(evidence),
        goal_reached=_goal_reached(evidence),
        evaluations=evidence.spent.evaluations,
        queries=evidence.spent.queries,
        warnings=[*warnings, *_warnings(evidence, target, held_out, surrogate)],
        seconds={name: round(seconds, 3) for name, seconds in evidence.seconds.items()},
        versions={name: version(name) for name in ("trompe", "torch", "numpy", "pyrender", "onnxruntime")},
        views=_with_fits(
            view_predictions(scene.views, evidence.logits_before["own"], after.get("own"), scene.label), evidence.fits
        ),
        held_out_views=view_predictions(
            scene.held_out, evidence.logits_before["held_out"], after.get("held_out"), scene.label
        ),
    )


def _with_fits(views: Sequence[ViewPrediction], fits: Sequence[ViewFit | None]) -> list[ViewPrediction]:
    told = [None if fit is None else ViewFidelity(**_rounded(fit._asdict())) for fit in fits or [None] * len(views)]
    return [view.model_copy(update={"fidelity": fit}) for view, fit in zip(views, told, strict=True)]


def _accuracy(evidence: Evidence, views: str) -> Accuracy:
    after = None if evidence.logits_after is None else evidence.logits_after[views]
    return accuracy(evidence.logits_before[views], after, evidence.scene.label)


def _goal_reached(evidence: Evidence) -> float | None:
    """Share of the own target views on which the classifier says what the attack wanted."""
    if evidence.logits_after is None:
        return None
    return float(evidence.scene.goal.reached(torch.from_numpy(evidence.logits_after["own"])).float().mean())


def _surrogate_accuracy(evidence: Evidence) -> Accuracy | None:
    """What the classifier says of the surrogate's own images, before and after."""
    if evidence.beyond is not None and evidence.beyond.predicted is not None:
        # A model of the target that is built on its own images shows these where nothing has moved.
        before, after = evidence.logits_before["own"], evidence.scene.classifier.predict(evidence.beyond.predicted)
        return accuracy(before, after, evidence.scene.label)
    if evidence.surrogate is None or evidence.painted is None:
        return None
    classifier, label = evidence.scene.classifier, evidence.scene.label
    before, after = (
        classifier.predict(_surrogate_images(evidence.surrogate, obj)) for obj in (evidence.scene.obj, evidence.painted)
    )
    return accuracy(before, after, label)


def _surrogate_images(surrogate: Surrogate, obj: Object3D) -> NDArray[np.uint8]:
    """The surrogate's images of ``obj`` in 8 bits, (views, H, W, 3)."""
    with torch.no_grad():
        shown = surrogate.render_all(surrogate.texels(textures_of(obj, device=surrogate.geometry.device)))
        images: NDArray[np.uint8] = shown.mul(255).round().byte().permute(0, 2, 3, 1).cpu().numpy()
    return images


def _judgement(judge: Classifier, evidence: Evidence) -> Judgement:
    def judged(views: str) -> Accuracy:
        after = None if evidence.after is None else judge.predict(evidence.after[views])
        return accuracy(judge.predict(evidence.before[views]), after, evidence.scene.label)

    held_out = judged("held_out") if evidence.scene.held_out else None
    return Judgement(classifier=judge.name, target=judged("own"), held_out=held_out)


def _calibration_fields(evidence: Evidence) -> dict[str, Any]:
    calibration = evidence.calibration
    if calibration is None:
        return {"surrogate_model": evidence.spec.surrogate, "surrogate_reason": "not built", "probe_renders": 0}
    mean = calibration.fidelity.mean()
    return {
        "surrogate_model": calibration.model,
        "surrogate_reason": calibration.reason,
        "probe_renders": calibration.renders,
        "fidelity": _rounded(mean),
    }


def _rounded(figures: Mapping[str, float]) -> dict[str, float]:
    return {name: round(value, 5) for name, value in figures.items()}


def _view_changes(evidence: Evidence) -> dict[str, Any]:
    """How the target's images changed, over all views: by the paper's constraint, and as people see it."""
    if evidence.after is None:
        return {"max_view_change": None}
    scene = evidence.scene
    before, after = (np.concatenate([each["own"], each["held_out"]]) for each in (evidence.before, evidence.after))
    views = (*scene.views, *scene.held_out)
    pixels = object_pixels(before, after, behind(views, scene.backdrops, scene.size))
    changes: dict[str, Any] = {"max_view_change": max_view_change(before, after)}
    if evidence.repainted is not None:
        beyond = share_beyond(before, after, pixels, epsilon=evidence.spec.epsilon)
        changes |= {"pixels_beyond_epsilon": beyond[0], "views_beyond_epsilon": beyond[1]}
        changes["texture_variation"] = total_variation(scene.obj.textures, evidence.repainted.textures)
    seen = perceived_change(before, after, pixels)
    return changes | ({} if seen is None else asdict(seen))


def _warnings(evidence: Evidence, target: Accuracy, held_out: Accuracy | None, surrogate: Accuracy | None) -> list[str]:
    found = [warning] if target.a_before > 0 and (warning := drop_warning(target)) else []
    calibration = evidence.calibration
    if calibration is not None and calibration.model != "diffuse" and not calibration.fidelity.good_enough:
        mean = calibration.fidelity.mean()
        found.append(
            f"The surrogate is outside its tolerance: mean error {mean['error'] * 255:.1f}/255 "
            f"(at most {MAX_ERROR * 255:.1f}), "
            f"{mean['explained']:.0%} of a random repaint's effect explained (at least {MIN_EXPLAINED:.0%})."
        )
    found += _promises(evidence, target, surrogate)
    if evidence.after is not None:
        found += _reach(evidence.spec, target, held_out)
    return found + _poor_views(evidence)


def _reach(spec: JobSpec, target: Accuracy, held_out: Accuracy | None) -> list[str]:
    """What to know of an attack that fooled few views, or few but its own."""
    more = "--views-per-step" if spec.attack_on == "light" else f"--pool {max(MORE_VIEWS, 2 * spec.n_views)}"
    wider = f"Attack more views ({more}, and more --steps)."
    warning = reach_warning(target, held_out, stronger=_REMEDIES[spec.attack_on], wider=wider)
    return [warning] if warning else []


_REMEDIES: Final[Mapping[str, str]] = {
    "texture": "Try a larger --epsilon or more --steps, or let more texels change (a smaller --tau, a larger --keep).",
    "light": "Try wider ranges (--sun) or more places (--steps).",
    "vertices": "Try a larger --vertex-budget or more --steps.",
}


_UNALTERED: Final = (
    "No texel was altered: the classifier's gradient is zero on every view (a saturated softmax, or a step that hides "
    "gradients). Try --loss margin, or attack it by its scores (--queries)."
)
_UNALTERED_THROUGH_MASKS: Final = (
    "No texel was altered: through the pixels that --tau leaves nothing was found that fools more views than the "
    "unpainted object. Try a smaller --tau, or choose texels by --keep instead."
)


def _promises(evidence: Evidence, target: Accuracy, surrogate: Accuracy | None) -> list[str]:
    """What to know of an attack that came to nothing, or to less than the surrogate promised."""
    found = []
    painted = evidence.repainted
    if painted is not None and texels_altered(evidence.scene.obj.textures, painted.textures) == 0:
        found.append(_UNALTERED if evidence.spec.tau is None else _UNALTERED_THROUGH_MASKS)
    gap = transfer_gap(surrogate, target)
    if gap is not None and gap > LARGE_GAP:
        found.append(
            f"The surrogate promised more than the target kept: its A_drop is larger by {gap:.2f}."
            + (" Try --surrogate auto, or look at the fidelity." if evidence.beyond is None else "")
        )
    return found


def _poor_views(evidence: Evidence) -> list[str]:
    """Names the views on which the surrogate is far off: on the unpainted object, or on what the attack changed."""
    if evidence.surrogate is None:
        return []
    fits = {index: fit for index, fit in enumerate(evidence.fits) if fit is not None}
    errors = dict(enumerate(evidence.surrogate.clean_errors())) | {index: fit.error for index, fit in fits.items()}
    off = {index: 255 * error for index, error in errors.items() if error > POOR_VIEW}
    unlike = {index: 1 - fit.explained for index, fit in fits.items() if fit.poor}
    found = []
    if off:
        named = _named(evidence.scene, off, "{:.1f}")
        found.append(f"The surrogate is off by more than {255 * POOR_VIEW:.0f}/255 on views {named}.")
    if unlike:
        named = _named(evidence.scene, unlike, "{:.0%}")
        found.append(
            f"More than {1 - MIN_EXPLAINED:.0%} of what the attack changed is not as the surrogate predicted it on "
            f"views {named}."
        )
    return found


def _named(scene: Scene, poor: Mapping[int, float], figure: str) -> str:
    """Views by number and camera with their figures, the largest first; only the first few of many."""
    named = []
    for index in sorted(poor, key=lambda index: -poor[index])[:NAMED_VIEWS]:
        camera = scene.views[index].camera
        where = f"azimuth {camera.azimuth:.0f}, elevation {camera.elevation:.0f}"
        named.append(f"{index} ({where}): {figure.format(poor[index])}")
    more = f", and {len(poor) - NAMED_VIEWS} more" if len(poor) > NAMED_VIEWS else ""
    return "; ".join(named) + more


def saliency_views(scene: Scene) -> NDArray[np.int64]:
    """The views whose saliency is shown."""
    distinct = _distinct(scene)
    return distinct[representative(len(distinct), SALIENCY_VIEWS)]


def _pictures(evidence: Evidence) -> dict[str, bytes]:
    scene = evidence.scene
    title = f"{scene.object_name} as {_short_name(scene, scene.label)!r}, {scene.classifier.name}"
    sheets = _saliency(evidence, f"Saliency of {title}")
    if evidence.after is not None:
        sheets |= _before_and_after(evidence, evidence.after, title)
    more = {} if evidence.beyond is None else evidence.beyond.pictures
    pictures: dict[str, Image.Image | NDArray[np.uint8]] = {**sheets, **more}
    return {name: encode_png(picture) for name, picture in pictures.items()}


def _saliency(evidence: Evidence, title: str) -> dict[str, Image.Image]:
    """On some views, and where there was an attack on the texture and the object too; none without gradients."""
    scene, maps = evidence.scene, evidence.maps
    if maps is None:
        return {}
    some = saliency_views(scene)
    own, spec = evidence.before["own"][some], evidence.spec
    sheet = saliency_sheet(own, maps[some], tau=spec.tau, scope=spec.saliency_scope, title=title, columns=3)
    sheets = {"saliency.png": sheet}
    if evidence.scores is not None and evidence.hot is not None:
        sheets["saliency_textures.png"] = saliency_texture_sheet(scene.obj.textures, evidence.scores, title=title)
        sheets["saliency_object.png"] = saliency_object_sheet(own, maps[some], evidence.hot, title=title)
    return sheets


def _before_and_after(evidence: Evidence, after: Images, title: str) -> dict[str, Image.Image]:
    scene, own = evidence.scene, evidence.before["own"]
    logits_before, logits_after = evidence.logits_before["own"], (evidence.logits_after or {})["own"]
    distinct = _distinct(scene)
    shown = distinct[representative(len(distinct), SHEET_VIEWS)]
    few = distinct[representative(len(distinct), DIFFERENCE_VIEWS)]
    changed = f"epsilon {evidence.spec.epsilon:g}" if evidence.beyond is None else evidence.beyond.words
    sheets = {
        "contact_sheet.png": contact_sheet(
            own[shown],
            after["own"][shown],
            _verdicts(logits_before[shown], scene),
            _verdicts(logits_after[shown], scene),
            title=f"{title}, {changed}",
        ),
        "difference.png": difference_strip(own[few], after["own"][few], title=title),
        "predictions.png": prediction_histogram(
            _counts(logits_before, scene),
            _counts(logits_after, scene),
            label=_short_name(scene, scene.label),
            title=f"What {title}, is taken for: {len(own)} target views",
        ),
    }
    if evidence.repainted is not None:
        sheets["textures.png"] = texture_sheet(scene.obj.textures, evidence.repainted.textures, title=title)
    return sheets


def _counts(logits: NDArray[np.float32], scene: Scene) -> Counter[str]:
    """How many views were given each class, by name."""
    counts: Counter[str] = Counter()
    for index, number in predicted_classes(logits).items():
        counts[_short_name(scene, index)] += number
    return counts


def _short_name(scene: Scene, index: int) -> str:
    """The first of a class's names."""
    return scene.class_name(index).split(",")[0]


def _distinct(scene: Scene) -> NDArray[np.int64]:
    """Views that show something new: the paper's grid holds azimuth 0 twice, as 0 and as 360."""
    seen: dict[Camera, int] = {}
    for index, view in enumerate(scene.views):
        seen.setdefault(replace(view.camera, azimuth=view.camera.azimuth % 360), index)
    return np.array(list(seen.values()))


def _verdicts(logits: NDArray[np.float32], scene: Scene) -> list[Verdict]:
    best, probability = logits.argmax(axis=1), softmax(logits).max(axis=1)
    return [
        Verdict(scene.class_name(int(index)), float(share), bool(index == scene.label))
        for index, share in zip(best, probability, strict=True)
    ]
