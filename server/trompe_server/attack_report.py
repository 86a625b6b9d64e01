"""The report of a job: ``result.json``, the pictures, and the repainted object."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from importlib.metadata import version
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray

from trompe_server.attack.metrics import (
    accuracy,
    max_view_change,
    mean_texel_change,
    softmax,
    texels_altered,
    transfer_gap,
    view_predictions,
)
from trompe_server.classifiers import Classifier
from trompe_server.pipeline import Artifacts
from trompe_server.reports import (
    Verdict,
    contact_sheet,
    difference_strip,
    representative,
    saliency_sheet,
    texture_sheet,
)
from trompe_server.scene import Scene
from trompe_server.surrogate import Surrogate, textures_of
from trompe_server.surrogate.calibration import MAX_ERROR, MIN_EXPLAINED, Calibration
from trompe_shared.api import Accuracy, JobSpec, Judgement, Result
from trompe_shared.object3d import Object3D, encode_png

__all__ = ["Evidence", "public_files"]

Images = Mapping[str, NDArray[np.uint8]]
"""Target images (views, H, W, 3) of the attack's ``own`` views and of the ``held_out`` ones."""

SHEET_VIEWS: Final = 12
SALIENCY_VIEWS: Final = 6
DIFFERENCE_VIEWS: Final = 4
FEW_RECOGNISED: Final = 0.3
POOR_VIEW: Final = 3.0 / 255
NAMED_VIEWS: Final = 5


@dataclass(frozen=True)
class Evidence:
    """All that the report is written from. What belongs to the attack is ``None`` where there was none (n.a.)."""

    spec: JobSpec
    scene: Scene
    before: Images
    after: Images | None
    painted: Object3D | None
    maps: NDArray[np.float32]
    surrogate: Surrogate | None
    calibration: Calibration | None
    seconds: Mapping[str, float]

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


def public_files(evidence: Evidence, artifacts: Artifacts, *, warnings: Sequence[str]) -> tuple[str, ...]:
    """Write everything that is for the user; returns the names of the files."""
    files = _pictures(evidence)
    if evidence.painted is not None:
        files["adversarial.zip"] = evidence.painted.to_zip()
    files["result.json"] = _result(evidence, warnings).model_dump_json(indent=1).encode()
    for name, data in files.items():
        artifacts.write(name, data)
    return tuple(sorted(files))


def _result(evidence: Evidence, warnings: Sequence[str]) -> Result:
    spec, scene = evidence.spec, evidence.scene
    target = _accuracy(evidence, "own")
    surrogate = _surrogate_accuracy(evidence)
    painted, after = evidence.painted, evidence.logits_after or {}
    return Result(
        object=scene.object_name,
        label=scene.label,
        label_name=scene.class_name(scene.label) if scene.classifier.classes else None,
        classifier=scene.classifier.name,
        **spec.model_dump(include={"epsilon", "alpha", "tau", "seed", "steps"}),
        image_size=scene.size,
        surrogate=surrogate,
        target=target,
        held_out=_accuracy(evidence, "held_out") if scene.held_out else None,
        transfer_gap=transfer_gap(surrogate, target),
        judges=[_judgement(judge, evidence) for judge in scene.judges],
        **_calibration_fields(evidence),
        texels_altered=texels_altered(scene.obj.textures, painted.textures) if painted else None,
        mean_texel_change=mean_texel_change(scene.obj.textures, painted.textures) if painted else None,
        max_view_change=_max_view_change(evidence),
        warnings=[*warnings, *_warnings(evidence, target)],
        seconds={name: round(seconds, 3) for name, seconds in evidence.seconds.items()},
        versions={name: version(name) for name in ("trompe", "torch", "numpy", "pyrender", "onnxruntime")},
        views=view_predictions(scene.views, evidence.logits_before["own"], after.get("own"), scene.label),
        held_out_views=view_predictions(
            scene.held_out, evidence.logits_before["held_out"], after.get("held_out"), scene.label
        ),
    )


def _accuracy(evidence: Evidence, views: str) -> Accuracy:
    after = None if evidence.logits_after is None else evidence.logits_after[views]
    return accuracy(evidence.logits_before[views], after, evidence.scene.label)


def _surrogate_accuracy(evidence: Evidence) -> Accuracy | None:
    """What the classifier says of the surrogate's own images, before and after."""
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
        shown = surrogate.render_all(surrogate.texels(textures_of(obj)))
        images: NDArray[np.uint8] = shown.mul(255).round().byte().permute(0, 2, 3, 1).numpy()
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
        "fidelity": {name: round(value, 5) for name, value in mean.items()},
    }


def _max_view_change(evidence: Evidence) -> float | None:
    """Largest change of a pixel over all target views, the paper's constraint on the images."""
    if evidence.after is None:
        return None
    sets = (evidence.before, evidence.after)
    return max_view_change(*(np.concatenate([images["own"], images["held_out"]]) for images in sets))


def _warnings(evidence: Evidence, target: Accuracy) -> list[str]:
    found = []
    if 0 < target.a_before < FEW_RECOGNISED:
        found.append(
            f"Only {target.a_before:.0%} of the views were recognised before the attack: A_drop rests on few views."
        )
    calibration = evidence.calibration
    if calibration is not None and calibration.model != "diffuse" and not calibration.fidelity.good_enough:
        mean = calibration.fidelity.mean()
        found.append(
            f"The surrogate is outside its tolerance: mean error {mean['error'] * 255:.1f}/255 "
            f"(at most {MAX_ERROR * 255:.1f}), "
            f"{mean['explained']:.0%} of a random repaint's effect explained (at least {MIN_EXPLAINED:.0%})."
        )
    return found + _poor_views(evidence)


def _poor_views(evidence: Evidence) -> list[str]:
    """Names the views on which the surrogate is far off, worst first."""
    if evidence.surrogate is None:
        return []
    errors = evidence.surrogate.clean_errors()
    poor = sorted((index for index, error in enumerate(errors) if error > POOR_VIEW), key=lambda index: -errors[index])
    if not poor:
        return []
    named = []
    for index in poor[:NAMED_VIEWS]:
        camera = evidence.scene.views[index].camera
        named.append(
            f"{index} (azimuth {camera.azimuth:.0f}, elevation {camera.elevation:.0f}): {255 * errors[index]:.1f}"
        )
    more = f", and {len(poor) - NAMED_VIEWS} more" if len(poor) > NAMED_VIEWS else ""
    return [f"The surrogate is off by more than {255 * POOR_VIEW:.0f}/255 on views {'; '.join(named)}{more}."]


def _pictures(evidence: Evidence) -> dict[str, bytes]:
    scene = evidence.scene
    own = evidence.before["own"]
    title = f"{scene.object_name} as {scene.class_name(scene.label).split(',')[0]!r}, {scene.classifier.name}"
    distinct = _distinct(scene)
    some = distinct[representative(len(distinct), SALIENCY_VIEWS)]
    maps = evidence.maps[some]
    sheets = {
        "saliency.png": saliency_sheet(own[some], maps, tau=evidence.spec.tau, title=f"Saliency of {title}", columns=3)
    }
    if evidence.after is not None and evidence.painted is not None:
        shown = distinct[representative(len(distinct), SHEET_VIEWS)]
        sheets["contact_sheet.png"] = contact_sheet(
            own[shown],
            evidence.after["own"][shown],
            _verdicts(evidence.logits_before["own"][shown], scene),
            _verdicts((evidence.logits_after or {})["own"][shown], scene),
            title=f"{title}, epsilon {evidence.spec.epsilon:g}",
        )
        few = distinct[representative(len(distinct), DIFFERENCE_VIEWS)]
        sheets["difference.png"] = difference_strip(own[few], evidence.after["own"][few], title=title)
        sheets["textures.png"] = texture_sheet(scene.obj.textures, evidence.painted.textures, title=title)
    return {name: encode_png(sheet) for name, sheet in sheets.items()}


def _distinct(scene: Scene) -> NDArray[np.int64]:
    """Views that show something new: the paper's grid holds azimuth 0 twice, as 0 and as 360."""
    seen: dict[tuple[float, float, float], int] = {}
    for index, view in enumerate(scene.views):
        seen.setdefault((view.camera.azimuth % 360, view.camera.elevation, view.camera.distance), index)
    return np.array(list(seen.values()))


def _verdicts(logits: NDArray[np.float32], scene: Scene) -> list[Verdict]:
    best, probability = logits.argmax(axis=1), softmax(logits).max(axis=1)
    return [
        Verdict(scene.class_name(int(index)), float(share), bool(index == scene.label))
        for index, share in zip(best, probability, strict=True)
    ]
