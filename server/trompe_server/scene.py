"""From a job's options to what it works on: the object, the networks, the views and the renderer."""

import re
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from trompe_server.attack import framing_distance, grid_views, random_views
from trompe_server.classifiers import Classifier, WhiteBoxClassifier, load_classifier
from trompe_server.labels import resolve_label
from trompe_server.library import Library
from trompe_server.target import BackdropTarget, TargetRenderer
from trompe_shared.api import JobSpec
from trompe_shared.errors import ClassifierError
from trompe_shared.geometry import View
from trompe_shared.object3d import Object3D, decode_rgb, load_object
from trompe_shared.shipped import shipped_objects

__all__ = ["Scene", "open_scene"]

DEFAULT_ELEVATION: Final = (0.0, 50.0)
COLOURS: Final = {"white": (255, 255, 255), "black": (0, 0, 0)}


@dataclass(frozen=True)
class Scene:
    """What a job works on. ``label`` is the object's class index, ``views`` are attacked, ``held_out`` only judged."""

    obj: Object3D
    object_name: str
    label: int
    classifier: WhiteBoxClassifier
    judges: tuple[Classifier, ...]
    views: tuple[View, ...]
    held_out: tuple[View, ...]
    target: TargetRenderer
    backdrop: NDArray[np.uint8] | None
    """(H, W, 3), what stands behind the object in place of the views' uniform backgrounds."""

    @property
    def size(self) -> tuple[int, int]:
        """(H, W) of every image: what the attacked classifier takes."""
        return self.classifier.image_size

    def class_name(self, index: int) -> str:
        """Name of a class, or its number where the classifier has no names."""
        classes = self.classifier.classes
        return classes[index] if classes is not None else f"class {index}"


def open_scene(spec: JobSpec, *, library: Library, target: TargetRenderer) -> Scene:
    """Load what ``spec`` names. Raises ``TrompeError`` for what does not exist or does not fit together."""
    obj = load_object(library.object_bytes(spec.object))
    info = library.object(spec.object)
    classifier = _stored_classifier(spec.classifier, library)
    if not isinstance(classifier, WhiteBoxClassifier):
        raise ClassifierError(
            f"{classifier.name!r} gives scores but no gradients (.onnx), so it can judge, but not be attacked. "
            "Attack a .pt2 file and name this one as a judge (--judge)."
        )
    distance, elevation = _framing(spec, obj, info.name if info.shipped else None)
    colour, backdrop = COLOURS.get(spec.background) or _hex_colour(spec.background), None
    if colour is None:
        picture = decode_rgb(library.background_bytes(spec.background), spec.background)
        target = BackdropTarget(target, picture)
        colour, backdrop = COLOURS["black"], target.backdrop(classifier.image_size)
    return Scene(
        obj,
        info.name,
        resolve_label(spec.label, classifier.classes, classifier.n_classes),
        classifier,
        tuple(_stored_classifier(judge, library) for judge in spec.judges),
        *_views(spec, distance, elevation, colour),
        target,
        backdrop,
    )


def _stored_classifier(reference: str, library: Library) -> Classifier:
    info = library.classifier(reference)
    return load_classifier(library.classifier_path(reference), name=info.name, classes=info.classes)


def _framing(spec: JobSpec, obj: Object3D, shipped: str | None) -> tuple[float, tuple[float, float]]:
    """(distance, elevation range): the job's, else a shipped object's own, else what shows the object well."""
    own = shipped_objects()[shipped] if shipped is not None else None
    distance = spec.distance or (own.distance if own is not None else framing_distance(obj))
    elevation = spec.elevation or (own.elevation if own is not None else DEFAULT_ELEVATION)
    return distance, elevation


def _hex_colour(text: str) -> tuple[int, int, int] | None:
    if not re.fullmatch("#[0-9a-fA-F]{6}", text):
        return None
    red, green, blue = bytes.fromhex(text[1:])
    return red, green, blue


def _views(
    spec: JobSpec, distance: float, elevation: tuple[float, float], background: tuple[int, int, int]
) -> tuple[tuple[View, ...], tuple[View, ...]]:
    """The views that are attacked (the pool, else the paper's grid), and those held out."""

    def drawn(count: int, stream: int) -> tuple[View, ...]:
        generator = np.random.default_rng([spec.seed, stream])
        views = random_views(count, distance=distance, elevation=elevation, background=background, generator=generator)
        return tuple(views)

    held_out = drawn(spec.held_out, HELD_OUT_STREAM)
    if spec.pool:
        return drawn(spec.pool, POOL_STREAM), held_out
    grid = grid_views(
        distance=distance,
        elevation=elevation,
        azimuths=spec.azimuths,
        elevations=spec.elevations,
        background=background,
    )
    return tuple(grid), held_out


HELD_OUT_STREAM, POOL_STREAM = 1, 2
"""Keep the random numbers of held-out views, pool and probes (0) apart."""
