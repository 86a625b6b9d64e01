"""One attack without a service: for notebooks and scripts."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Final

import numpy as np

from trompe_server.attack import Budget, Goal, ViewDistribution, attack, start
from trompe_server.classifiers import Classifier, WhiteBoxClassifier, load_classifier
from trompe_server.image_pipelines import PIPELINES
from trompe_server.job.setup import (
    HELD_OUT_STREAM,
    POOL_STREAM,
    PROBE_STREAM,
    SAFE_MARGINS,
    JobRenderer,
    noise_numbers,
)
from trompe_server.judging.metrics import accuracy
from trompe_server.renderers import TargetRenderer
from trompe_server.spec.framing import framing_of
from trompe_server.spec.labels import resolve_labels
from trompe_server.surrogate import textures_of
from trompe_server.surrogate.calibration import build_surrogate, calibrate
from trompe_server.surrogate.fidelity import Fidelity
from trompe_shared.api import Accuracy, PipelineName, ViewOptions
from trompe_shared.errors import ClassifierError, SpecError
from trompe_shared.geometry import View
from trompe_shared.object3d import Object3D, load_object
from trompe_shared.shipped import shipped_objects

VIEWS: Final = 40
"""Default number of attacked views, and of held-out ones."""


@dataclass(frozen=True)
class AttackedObject:
    """A repainted object, and its accuracies in the surrogate, in the target and, if any, on its held-out views.

    fidelity: of the surrogate to the target; unless ``fidelity.good_enough`` the attack was made on wrong images.
    """

    painted: Object3D
    fidelity: Fidelity
    surrogate: Accuracy
    target: Accuracy
    held_out: Accuracy | None = None


def attack_object(
    obj: Object3D | str | Path,
    classifier: WhiteBoxClassifier | str | Path,
    *,
    label: str | int | Sequence[str | int],
    target: TargetRenderer,
    views: Sequence[View] | None = None,
    held_out: Sequence[View] | None = None,
    budget: Budget | None = None,
    steps: int = 30,
    seed: int = 0,
    image_pipeline: PipelineName = "robust",
) -> AttackedObject:
    """Repaint ``obj`` so that ``classifier`` no longer recognises ``label`` in the images of ``target``.

    Each of several labels counts as the object. ``obj`` and ``classifier`` can be paths or names of shipped ones, such
    as ``mug`` and ``tiny``. ``views`` and ``held_out`` (which may be empty) default to random cameras and lights that
    frame the object.
    ``budget`` defaults to epsilon 0.05, alpha 0.01. ``image_pipeline``: random changes of the attack's images before
    the classifier, as for a job. The same arguments give the same bytes. Raises ``TrompeError`` for inputs that cannot
    be read or do not fit together.
    """
    if image_pipeline not in SAFE_MARGINS:
        raise SpecError(f"Unknown image pipeline {image_pipeline!r}; choose one of {', '.join(SAFE_MARGINS)}.")
    if seed < 0:
        raise SpecError(f"`seed` must be 0 or more, got {seed}.")
    if steps < 1:
        raise SpecError(f"`steps` must be 1 or more, got {steps}.")
    for name, given in (("views", views), ("held_out", held_out)):
        if given is not None and not isinstance(given, Sequence):
            raise SpecError(f"`{name}` must be a list of views, got {given!r}; ViewDistribution.sample draws some.")
    if views is not None and not len(views):
        raise SpecError("There are no `views` to attack: give at least one, or leave `views` out for random ones.")
    obj = obj if isinstance(obj, Object3D) else _load(obj)
    network = load_classifier(classifier) if isinstance(classifier, str | Path) else classifier
    if not isinstance(network, Classifier):
        raise ClassifierError(f"A {type(network).__name__} is no classifier; wrap a torch module in NetworkClassifier.")
    if not isinstance(network, WhiteBoxClassifier):
        raise ClassifierError(f"{network.name!r} gives scores but no gradients (.onnx); use a .pt2 file.")
    labels = resolve_labels(label, network.classes, network.n_classes, network.name)
    goal = Goal(labels, safe=SAFE_MARGINS[image_pipeline])
    framing = framing_of(obj, ViewOptions())
    cameras = ViewDistribution(framing.distance, framing.elevation, centre=framing.centre)
    first, others = (
        cameras.sample(VIEWS, generator=np.random.default_rng([seed, stream])) if given is None else given
        for given, stream in ((views, POOL_STREAM), (held_out, HELD_OUT_STREAM))
    )
    if any(view.backdrop for view in (*first, *others)):
        raise SpecError("A view has a picture behind the object, which needs a job. Use views with a colour behind it.")
    renderer = JobRenderer(target, target.engine, attacked=True, noise=noise_numbers(target.engine, seed))
    own, unseen = renderer.shown(first), renderer.shown(others, held_out=True)
    budget = budget or Budget(epsilon=0.05, alpha=0.01)

    ask = partial(target.render, size=network.image_size)
    clean = ask(obj, own)
    calibration = calibrate(
        *(obj, own, clean, ask),
        wanted="auto",
        generator=np.random.default_rng([seed, PROBE_STREAM]),
        deterministic=renderer.engine.deterministic,
    )
    surrogate, textures = build_surrogate(calibration, obj, own, clean), textures_of(obj)
    state = attack(
        start(textures),
        textures,
        surrogate,
        network,
        goal=goal,
        budget=budget,
        steps=steps,
        seed=seed,
        pipeline=PIPELINES.get(image_pipeline),
    )
    painted = budget.repaint(obj, state.deltas)

    images = [
        [surrogate.images(each) for each in (obj, painted)],
        [clean, ask(painted, own)],
    ]
    if unseen:
        images.append([ask(each, unseen) for each in (obj, painted)])
    judged = [accuracy(network.predict(before), network.predict(after), goal.labels) for before, after in images]
    return AttackedObject(painted, calibration.fidelity, *judged)


def _load(source: str | Path) -> Object3D:
    shipped = shipped_objects().get(str(source))
    return load_object(source if shipped is None else shipped.path)
