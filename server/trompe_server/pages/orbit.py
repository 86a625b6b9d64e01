"""Input of the orbit: the object before and after in the browser, to be turned and classified."""

from collections.abc import Mapping, Sequence
from typing import Any, Final

from trompe_server.api.services import Services
from trompe_server.errors import NotFoundError
from trompe_server.job.protocol import SAILENV
from trompe_server.pages.serving import static
from trompe_shared.api import ADVERSARIAL, ClassifierInfo, Job, JudgementSpec, Result, ViewPrediction
from trompe_shared.geometry import FIELD_OF_VIEW
from trompe_shared.object3d import Object3D, load_object
from trompe_shared.three import FOLDER, LIGHTS, THREE

ARCHIVES: Final = (ADVERSARIAL + SAILENV, f"{ADVERSARIAL}.zip")
"""Endings of the repainted object's SAILenv zip, the first one if there are both."""
PLAIN: Final = "#ffffff"
"""Background in place of a picture."""


def orbit(result: Result, job: str, classifiers: Sequence[ClassifierInfo]) -> Mapping[str, Any] | None:
    """The orbit's JSON, which begins at a fooled view; ``None`` without an attack."""
    views = result.held_out_views or result.views
    fooled = (view for view in views if view.before in result.labels and view.after not in result.labels)
    start = next(fooled, views[0])
    if start.after is None:
        return None
    return {
        "files": {name: static(f"{FOLDER.name}/{file}") for name, file in (("three", THREE), ("lights", LIGHTS))},
        "models": {side: f"/jobs/{job}/models/{side}.glb" for side in ("before", "after")},
        "label": " or ".join(map(str, result.label_names or result.labels)),
        "classifiers": _choices(classifiers, result),
        "size": result.image_size,
        "fov": FIELD_OF_VIEW,
        "centred": result.spec.views.looks_at == "object",
        "start": _pose(start),
    }


def painted(services: Services, job: Job, side: str) -> Object3D:
    """The object ``before`` or ``after`` the attack. Raises ``NotFoundError`` unless it is stored."""
    if isinstance(job.spec, JudgementSpec):
        raise NotFoundError(f"Job {job.id} is a judgement and repaints no object; give the id of an attack.")
    if side == "before":
        return load_object(services.library.object_bytes(job.attack.object))
    for ending in ARCHIVES:
        for name in job.artifacts:
            if name.endswith(ending):
                return load_object(services.artifacts(job.id).read(name))
    raise NotFoundError(f"Job {job.id} has no repainted object.")


def _choices(classifiers: Sequence[ClassifierInfo], result: Result) -> list[dict[str, Any]]:
    """Networks to choose from with the object's classes. The job's own is first, also if it is not stored, as
    torchvision's are; it has indices, since two of its classes can have one name."""
    own, stored = result.spec.victim.classifier, {info.reference: info.name for info in classifiers}
    named = result.label_names or result.labels
    return [
        {"reference": each, "name": name, "labels": result.labels if each == own else named}
        for each, name in ({own: stored.get(own, own)} | stored).items()
    ]


def _pose(view: ViewPrediction) -> Mapping[str, Any]:
    """Camera, light and background. Angles in degrees, azimuths in [-180, 180); distance in metres."""
    return {
        "azimuth": _centred(view.azimuth),
        "elevation": view.elevation,
        "distance": view.distance,
        "light_azimuth": _centred(view.light_azimuth),
        "light_elevation": view.light_elevation,
        "intensity": view.light_intensity,
        "ambient": view.light_ambient,
        "colour": [channel / 255 for channel in view.light_colour],
        "background": view.background if view.background.startswith("#") else PLAIN,
    }


def _centred(azimuth: float) -> float:
    return (azimuth + 180) % 360 - 180
