"""From a job's options to what it works on: the object, the networks, the views and the renderer."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray

from trompe_server.attack import (
    Backgrounds,
    Goal,
    TexelMasks,
    ViewDistribution,
    grid_views,
    material_texels,
    painted_texels,
)
from trompe_server.attack.goal import SAFE_MARGIN
from trompe_server.checks import check_diverse, check_keep, check_queries, check_saliency, check_vertices
from trompe_server.classifiers import (
    Classifier,
    DiverseClassifier,
    ScoreBasedClassifier,
    WhiteBoxClassifier,
    as_ensemble,
    load_classifier,
    score_based,
)
from trompe_server.labels import resolve_label
from trompe_server.library import Library
from trompe_server.target import BackdropTarget, TargetRenderer, fitted
from trompe_shared.api import JobSpec
from trompe_shared.errors import ClassifierError, SpecError
from trompe_shared.geometry import View, colour_of, framing_distance
from trompe_shared.object3d import Object3D, decode_rgb, load_object
from trompe_shared.shipped import shipped_objects

__all__ = ["Scene", "open_scene"]

FAR: Final = 1000.0
"""A safe margin that no view reaches: all are won by as much as possible."""

SAILENV: Final = "sailenv"
DEFAULT_ELEVATION: Final = (0.0, 50.0)
LEAST_QUERIES: Final = 2
Image8 = NDArray[np.uint8]


@dataclass(frozen=True)
class Scene:
    """What a job works on.

    classifier: the first of those that are attacked, by which the result is judged. members: all of them, as the attack
    needs them; ``diversity``: the seed by which its steps show them images at random places, if at all. goal: what they
    should say. within: masks of the texels that may change. views: what is attacked; ``held_out`` ones are only judged.
    backdrops: the pictures that views name, (H, W, 3). original: the file that the object came as, and its name;
    ``None`` where that is ``obj``. device: where torch computes. lights_tried_on: the views by which an attack on the
    light looks for it; none of them is judged.
    """

    obj: Object3D
    object_name: str
    classifier: Classifier
    members: tuple[WhiteBoxClassifier, ...]
    judges: tuple[Classifier, ...]
    goal: Goal
    within: tuple[TexelMasks, ...]
    views: tuple[View, ...]
    held_out: tuple[View, ...]
    target: TargetRenderer
    backdrops: Mapping[str, Image8]
    original: tuple[bytes, str] | None = None
    device: str = "cpu"
    lights_tried_on: tuple[View, ...] = ()
    diversity: int | None = None

    @property
    def label(self) -> int:
        """The object's true class."""
        return self.goal.label

    @property
    def size(self) -> tuple[int, int]:
        """(H, W) of every image: what the attacked classifier takes."""
        return self.classifier.image_size

    @property
    def backgrounds(self) -> Backgrounds | None:
        """What the attacked views stand in front of; ``None`` where that is the same for all."""
        names: dict[str | tuple[int, int, int], int] = {}
        own = [names.setdefault(view.backdrop or view.background, len(names)) for view in self.views]
        if len(names) == 1:
            return None
        pictures = np.empty((len(names), *self.size, 3), np.uint8)
        for name, number in names.items():
            pictures[number] = self.backdrops[name] if isinstance(name, str) else name
        return Backgrounds(torch.from_numpy(pictures), own)

    @property
    def shown(self) -> tuple[WhiteBoxClassifier, ...]:
        """What the steps of an attack show their images to: the members, at random places where that is asked for."""
        if self.diversity is None:
            return self.members
        return tuple(DiverseClassifier(member, self.diversity) for member in self.members)

    @property
    def white_box(self) -> bool:
        """Whether gradients are computed, not estimated from scores."""
        return isinstance(self.classifier, WhiteBoxClassifier)

    @property
    def queries(self) -> int | None:
        """Scores asked so far of a classifier that gives no gradients."""
        return sum(each.queries for each in self.members if isinstance(each, ScoreBasedClassifier)) or None

    def class_name(self, index: int) -> str:
        """Name of a class, or its number where the classifier has no names."""
        classes = self.classifier.classes
        return classes[index] if classes is not None else f"class {index}"


def open_scene(spec: JobSpec, *, library: Library, target: TargetRenderer, device: str = "cpu") -> Scene:
    """Load what ``spec`` names, networks on ``device``.

    Raises ``TrompeError`` for what does not exist or does not fit together.
    """
    obj = load_object(library.object_bytes(spec.object))
    info = library.object(spec.object)
    stored = partial(_stored_classifier, library=library, device=device)
    classifier = stored(spec.classifier)
    distance, elevation = _framing(spec, obj, info.name if info.shipped else None)
    drawn = partial(_drawn, spec, ViewDistribution(distance, elevation, **dict(spec.ranges)))
    pictures = {name: _picture(name, library) for name in spec.background if colour_of(name) is None}
    return Scene(
        obj,
        info.name,
        classifier,
        _members(spec, classifier, [stored(name) for name in spec.ensemble]),
        tuple(stored(judge) for judge in spec.judges),
        _goal(spec, classifier),
        _within(spec, obj, library),
        drawn(spec.pool, POOL_STREAM) if spec.pool else _grid(spec, distance, elevation),
        drawn(spec.held_out, HELD_OUT_STREAM),
        BackdropTarget(target, pictures) if pictures else target,
        {name: fitted(picture, classifier.image_size) for name, picture in pictures.items()},
        None if info.format == SAILENV else library.original(spec.object),
        device,
        drawn(spec.n_views_per_step, LIGHT_STREAM) if spec.attack_on == "light" else (),
        spec.seed if spec.diverse else None,
    )


def _goal(spec: JobSpec, classifier: Classifier) -> Goal:
    def index(label: str | int) -> int:
        return resolve_label(label, classifier.classes, classifier.n_classes)

    target = None if spec.target_label is None else index(spec.target_label)
    goal = Goal(index(spec.label), target, spec.top_k, spec.loss, FAR if spec.diverse else SAFE_MARGIN)
    goal.check(classifier.n_classes)
    return goal


def _members(spec: JobSpec, classifier: Classifier, others: Sequence[Classifier]) -> tuple[WhiteBoxClassifier, ...]:
    """What is attacked: the classifier (by its scores where it has no gradients) and the others of its ensemble."""
    if isinstance(classifier, WhiteBoxClassifier):
        check_queries(spec, classifier.name)
        first = classifier
    else:
        first = _by_scores(spec, classifier)
    blind = [other.name for other in others if not isinstance(other, WhiteBoxClassifier)]
    if blind:
        raise ClassifierError(f"{blind} give scores but no gradients (.onnx), so they cannot be in an ensemble.")
    return as_ensemble([first, *(other for other in others if isinstance(other, WhiteBoxClassifier))])


def _by_scores(spec: JobSpec, classifier: Classifier) -> WhiteBoxClassifier:
    check_vertices(spec, classifier.name)
    queries = LEAST_QUERIES if spec.attack_on == "light" else spec.queries  # a light is found without gradients
    if queries is None:
        raise ClassifierError(
            f"{classifier.name!r} gives scores but no gradients (.onnx). Attack a .pt2 file and name this one as a "
            "judge (--judge), or let gradients be estimated from scores (--queries 10)."
        )
    check_saliency(spec, classifier.name)
    check_diverse(spec, classifier.name)
    behind = colour_of(spec.background[0]) if len(spec.background) == 1 else None
    background = None if behind is None else torch.tensor(behind)[:, None, None] / 255
    return score_based(classifier, seed=spec.seed, queries=queries, sigma=spec.epsilon, background=background)


def _within(spec: JobSpec, obj: Object3D, library: Library) -> tuple[TexelMasks, ...]:
    """The masks of texels that the options name: materials, painted pictures. Raises ``SpecError`` where they leave
    none."""
    check_keep(spec, n_texels=obj.n_texels)
    masks: list[TexelMasks] = []
    if spec.materials:
        masks.append(material_texels(obj, spec.materials))
    if spec.masks:
        masks.append(painted_texels(obj, {name: _picture(image, library) for name, image in spec.masks.items()}))
    if masks and not any(torch.stack([mask[name] for mask in masks]).all(0).any() for name in obj.textures):
        raise SpecError(
            f"The mask images leave none of the texels of {sorted(spec.materials)}: paint white in their textures, or "
            "name other materials."
        )
    return tuple(masks)


def _picture(reference: str, library: Library) -> Image8:
    return decode_rgb(library.background_bytes(reference), reference)


def _stored_classifier(reference: str, *, library: Library, device: str) -> Classifier:
    info = library.classifier(reference)
    return load_classifier(library.classifier_path(reference), name=info.name, classes=info.classes, device=device)


def _framing(spec: JobSpec, obj: Object3D, shipped: str | None) -> tuple[float, tuple[float, float]]:
    """(distance, elevation range): the job's, else a shipped object's own, else what shows the object well."""
    own = shipped_objects()[shipped] if shipped is not None else None
    distance = spec.distance or (own.distance if own is not None else framing_distance(obj.radius))
    elevation = spec.elevation or (own.elevation if own is not None else DEFAULT_ELEVATION)
    return distance, elevation


def _drawn(spec: JobSpec, distribution: ViewDistribution, count: int, stream: int) -> tuple[View, ...]:
    """Random views, other ones for each ``stream``."""
    generator = np.random.default_rng([spec.seed, stream])
    return _before(spec.background, distribution.sample(count, generator=generator), generator)


def _grid(spec: JobSpec, distance: float, elevation: tuple[float, float]) -> tuple[View, ...]:
    """The paper's views."""
    grid = grid_views(
        distance=distance,
        elevation=elevation,
        azimuths=spec.azimuths,
        elevations=spec.elevations,
        background=(255, 255, 255),
    )
    return _before(spec.background, grid, np.random.default_rng([spec.seed, GRID_STREAM]))


HELD_OUT_STREAM, POOL_STREAM, GRID_STREAM, LIGHT_STREAM = 1, 2, 3, 4
"""Keep the random numbers of held-out views, pool, the grid's backgrounds, tried lights and probes (0) apart."""


def _before(backgrounds: Sequence[str], views: Sequence[View], generator: np.random.Generator) -> tuple[View, ...]:
    """Each of ``views`` in front of one of ``backgrounds``, drawn at random where there are several."""
    drawn = [backgrounds[k] for k in generator.integers(len(backgrounds), size=len(views))]
    return tuple(_in_front_of(name, view) for name, view in zip(drawn, views, strict=True))


def _in_front_of(background: str, view: View) -> View:
    colour = colour_of(background)
    return replace(view, backdrop=background) if colour is None else replace(view, background=colour)
