"""From the options of a job to its objects: the 3D object, the networks, the views and the renderer."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache, partial
from typing import Final

import numpy as np
import torch

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
from trompe_server.classifiers import (
    Classifier,
    ScoreBasedClassifier,
    WhiteBoxClassifier,
    as_ensemble,
    load_classifier,
    score_based,
)
from trompe_server.image_pipelines import PIPELINES, ImagePipeline
from trompe_server.judging.judge import Judge
from trompe_server.library import Library
from trompe_server.renderers import BackdropTarget, TargetRenderer, fitted
from trompe_server.spec.checks import check_gradients, check_keep, check_members
from trompe_server.spec.framing import Framing, framing_of
from trompe_server.spec.labels import resolve_label, resolve_labels
from trompe_server.surrogate import Image8
from trompe_shared.api import JobSpec, PipelineName
from trompe_shared.colours import colour_of
from trompe_shared.engine import EngineInfo
from trompe_shared.errors import SpecError
from trompe_shared.geometry import View
from trompe_shared.object3d import Object3D, decode_rgb, load_object

SAFE_MARGINS: Final[Mapping[PipelineName, float]] = {"none": SAFE_MARGIN, "robust": 3.0, "transfer": 1000.0}
"""Margin from which a view counts as safely won, by image pipeline: a chain of other draws takes some of it. No view
reaches the last: each is won by as much as possible."""

PROBE_STREAM, HELD_OUT_STREAM, POOL_STREAM, GRID_STREAM, NOISE_STREAM = range(5)
"""Separate random streams of probes, held-out views, pool, backgrounds of the grid and numbers of noise."""

FEWEST, PARTS = 60, 4
"""An attack starts with this part of its pool, and at least with so many views."""

KEPT_NETWORKS: Final = 2
"""Classifiers that stay loaded for the next job: loading one takes seconds."""

SAILENV: Final = "sailenv"


@dataclass(frozen=True)
class JobRenderer:
    """A renderer of a job, attacked or only judging.

    noise: numbers of the noise in pictures of own and of held-out views; 0 if it is deterministic.
    """

    target: TargetRenderer
    engine: EngineInfo
    attacked: bool
    noise: tuple[int, int]

    def shown(self, views: Sequence[View], *, held_out: bool = False) -> list[View]:
        """``views`` with the number of their noise."""
        return [replace(view, noise=self.noise[held_out]) for view in views]


@dataclass(frozen=True)
class JobSetup:
    """Everything a job works on.

    classifier: the first attacked one, which also judges. members: all attacked ones. pipeline: what happens to the
    attack's images before them, if anything. within: masks of the texels that may change. views: attacked views.
    further: views of the pool that are attacked if the paint loses them. held_out: views that only judge. renderers:
    attacked ones, then those that only judge. backdrops: the pictures that views name, (H, W, 3). original: uploaded
    file and its name; ``None`` if that is ``obj``. device: torch device.
    """

    obj: Object3D
    object_name: str
    classifier: Classifier
    members: tuple[WhiteBoxClassifier, ...]
    judges: tuple[Classifier, ...]
    goal: Goal
    within: tuple[TexelMasks, ...]
    views: tuple[View, ...]
    further: tuple[View, ...]
    held_out: tuple[View, ...]
    renderers: tuple[JobRenderer, ...]
    backdrops: Mapping[str, Image8]
    original: tuple[bytes, str] | None = None
    device: str = "cpu"
    pipeline: ImagePipeline | None = None

    @property
    def attacked(self) -> tuple[JobRenderer, ...]:
        return tuple(renderer for renderer in self.renderers if renderer.attacked)

    @property
    def labels(self) -> tuple[int, ...]:
        """The object's true classes."""
        return self.goal.labels

    @property
    def size(self) -> tuple[int, int]:
        """(H, W) of all images: the input size of the attacked classifier."""
        return self.classifier.image_size

    def backgrounds(self, views: Sequence[View]) -> Backgrounds | None:
        """Backgrounds of ``views``; ``None`` if they all have the same."""
        names: dict[str | tuple[int, int, int], int] = {}
        own = [names.setdefault(view.backdrop or view.background, len(names)) for view in views]
        if len(names) == 1:
            return None
        pictures = np.empty((len(names), *self.size, 3), np.uint8)
        for name, number in names.items():
            pictures[number] = self.backdrops[name] if isinstance(name, str) else name
        return Backgrounds(torch.from_numpy(pictures), own)

    @property
    def white_box(self) -> bool:
        """Whether gradients are exact, not estimated from scores."""
        return isinstance(self.classifier, WhiteBoxClassifier)

    @property
    def queries(self) -> int | None:
        """Scores asked so far of a score-only classifier."""
        return sum(each.queries for each in self.members if isinstance(each, ScoreBasedClassifier)) or None

    @cached_property
    def judge(self) -> Judge:
        """The attacked classifier as a judge."""
        return Judge.of(self.classifier, self.labels)


def open_setup(
    spec: JobSpec,
    *,
    library: Library,
    target: TargetRenderer,
    more_targets: Sequence[TargetRenderer] = (),
    judge_targets: Sequence[TargetRenderer] = (),
    device: str = "cpu",
) -> JobSetup:
    """Load everything that ``spec`` names, networks on ``device``.

    ``target`` and ``more_targets`` are attacked, ``judge_targets`` only judge.

    Raises ``TrompeError`` for names that do not exist and options that do not fit together.
    """
    obj = load_object(library.object_bytes(spec.object))
    info = library.objects.find(spec.object)
    stored = partial(_stored_classifier, library=library, device=device)
    classifier = stored(spec.victim.classifier)
    framing = framing_of(obj, spec.views, shipped=info.name if info.shipped else None)
    distribution = ViewDistribution(framing.distance, framing.elevation, spec.views.ranges, centre=framing.centre)
    drawn = partial(drawn_views, distribution, spec.views.background, seed=spec.search.seed)
    views = _grid(spec, framing) if spec.views.grid else drawn(spec.views.count, stream=POOL_STREAM)
    first = _first(spec, len(views), renderers=1 + len(more_targets))
    named = [name for name in spec.views.background if colour_of(name) is None]
    pictures = {name: fitted(_picture(name, library), classifier.image_size) for name in named}
    return JobSetup(
        obj,
        info.name,
        classifier,
        _members(spec, classifier, [stored(name) for name in spec.victim.ensemble]),
        tuple(stored(judge) for judge in spec.judges.networks),
        _goal(spec, classifier),
        _within(spec, obj, library),
        views[:first],
        views[first:],
        drawn(spec.views.held_out, stream=HELD_OUT_STREAM),
        (
            *(_renderer(spec, each, pictures, attacked=True) for each in (target, *more_targets)),
            *(_renderer(spec, each, pictures, attacked=False) for each in judge_targets),
        ),
        pictures,
        None if info.format == SAILENV else library.original(spec.object),
        device,
        PIPELINES.get(spec.image_pipeline),
    )


def _first(spec: JobSpec, count: int, *, renderers: int) -> int:
    """Number of the ``count`` views that an attack starts with: all of them if one choice rests on all, or if each
    renderer would need others."""
    if spec.views.grid or spec.paint.tau is not None or spec.paint.keep is not None or spec.victim.queries is not None:
        return count
    return count if renderers > 1 else min(count, max(FEWEST, -(-count // PARTS)))


def _renderer(spec: JobSpec, target: TargetRenderer, pictures: Mapping[str, Image8], *, attacked: bool) -> JobRenderer:
    noise = noise_numbers(target.engine, spec.search.seed)
    return JobRenderer(BackdropTarget(target, pictures) if pictures else target, target.engine, attacked, noise)


def noise_numbers(engine: EngineInfo, seed: int) -> tuple[int, int]:
    """Numbers of the noise in pictures of own and of held-out views; 0 for a deterministic engine."""
    if engine.deterministic:
        return 0, 0
    own, held_out = np.random.default_rng([seed, NOISE_STREAM]).integers(2**31, size=2).tolist()
    return own, held_out


def _goal(spec: JobSpec, classifier: Classifier) -> Goal:
    known = classifier.classes, classifier.n_classes, classifier.name
    target = None if spec.goal.target is None else resolve_label(spec.goal.target, *known)
    goal = Goal(
        resolve_labels(spec.goal.label, *known),
        target,
        spec.goal.top_k,
        spec.goal.loss,
        SAFE_MARGINS[spec.image_pipeline],
    )
    goal.check(classifier.n_classes)
    return goal


def _members(spec: JobSpec, classifier: Classifier, others: Sequence[Classifier]) -> tuple[WhiteBoxClassifier, ...]:
    """All attacked classifiers; the first one by its scores if it gives no gradients."""
    check_gradients(spec, classifier.name, white_box=isinstance(classifier, WhiteBoxClassifier))
    check_members([(other.name, isinstance(other, WhiteBoxClassifier)) for other in others])
    first = classifier if isinstance(classifier, WhiteBoxClassifier) else _by_scores(spec, classifier)
    return as_ensemble([first, *(other for other in others if isinstance(other, WhiteBoxClassifier))])


def _by_scores(spec: JobSpec, classifier: Classifier) -> WhiteBoxClassifier:
    queries, names = spec.victim.queries, spec.views.background
    assert queries is not None  # check_gradients
    behind = colour_of(names[0]) if len(names) == 1 else None
    background = None if behind is None else torch.tensor(behind)[:, None, None] / 255
    return score_based(
        classifier, seed=spec.search.seed, queries=queries, sigma=spec.paint.epsilon, background=background
    )


def _within(spec: JobSpec, obj: Object3D, library: Library) -> tuple[TexelMasks, ...]:
    """Masks of texels by material and by picture. Raises ``SpecError`` if they leave no texel."""
    paint = spec.paint
    check_keep(paint.keep, n_texels=obj.n_texels)
    masks: list[TexelMasks] = []
    if paint.materials:
        masks.append(material_texels(obj, paint.materials))
    if paint.masks:
        masks.append(painted_texels(obj, {name: _picture(image, library) for name, image in paint.masks.items()}))
    if masks and not any(torch.stack([mask[name] for mask in masks]).all(0).any() for name in obj.textures):
        raise SpecError(
            f"The mask images leave no texel of {sorted(paint.materials)}: paint white in their textures, or name "
            "other materials."
        )
    return tuple(masks)


def _picture(reference: str, library: Library) -> Image8:
    return decode_rgb(library.background_bytes(reference), reference)


def _stored_classifier(reference: str, *, library: Library, device: str) -> Classifier:
    info = library.classifier(reference)
    classes = None if info.classes is None else tuple(info.classes)
    return _loaded(library.classifier_path(reference), info.name, classes, device)


@lru_cache(maxsize=KEPT_NETWORKS)
def _loaded(path: str, name: str, classes: tuple[str, ...] | None, device: str) -> Classifier:
    return load_classifier(path, name=name, classes=classes, device=device)


def drawn_views(
    distribution: ViewDistribution, backgrounds: Sequence[str], count: int, *, seed: int, stream: int
) -> tuple[View, ...]:
    """Random views of one ``stream``, in front of colours and pictures by name."""
    generator = np.random.default_rng([seed, stream])
    return _before(backgrounds, distribution.sample(count, generator=generator), generator)


def _grid(spec: JobSpec, framing: Framing) -> tuple[View, ...]:
    grid = grid_views(
        distance=framing.distance,
        elevation=framing.elevation,
        centre=framing.centre,
        azimuths=spec.views.azimuths,
        elevations=spec.views.elevations,
        background=(255, 255, 255),
    )
    return _before(spec.views.background, grid, np.random.default_rng([spec.search.seed, GRID_STREAM]))


def _before(backgrounds: Sequence[str], views: Sequence[View], generator: np.random.Generator) -> tuple[View, ...]:
    """Each of ``views`` in front of one of ``backgrounds``, drawn at random."""
    drawn = [backgrounds[k] for k in generator.integers(len(backgrounds), size=len(views))]
    return tuple(_in_front_of(name, view) for name, view in zip(drawn, views, strict=True))


def _in_front_of(background: str, view: View) -> View:
    colour = colour_of(background)
    return replace(view, backdrop=background) if colour is None else replace(view, background=colour)
