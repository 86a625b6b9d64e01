"""From what a judgement has seen to its manifest."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray

from trompe_server.image_pipelines import SUITE, ImagePipeline
from trompe_server.judgement.sources import JudgedObject
from trompe_server.judgement.suites import Suite
from trompe_server.judging.judge import Judge
from trompe_server.judging.metrics import camera_and_light, drop_warning, margins
from trompe_server.judging.objects import ObjectPair, texture_changes
from trompe_server.judging.visibility import paint_warnings, visibility_of
from trompe_server.surrogate import behind
from trompe_server.system.versions import versions
from trompe_shared.api import (
    AS_RENDERED,
    Accuracy,
    Cell,
    Finding,
    JudgedNetwork,
    JudgedRenderer,
    JudgementSpec,
    Manifest,
    Predictions,
    ViewRecord,
    Visibility,
    levels_within,
)
from trompe_shared.engine import EngineInfo
from trompe_shared.geometry import Camera, Light, View

Images = NDArray[np.uint8]
Logits = NDArray[np.float32]
PIPELINES: Final[Mapping[str, ImagePipeline | None]] = {AS_RENDERED: None, **SUITE}
"""What happens to the images before the networks."""

DROPS: Final = ("a_drop", "a_drop_interval", "a_drop_with_neighbours", "a_drop_with_neighbours_interval")
"""Figures that two different objects do not have."""


@dataclass(frozen=True)
class Judged:
    """What was asked for, what was looked at, and what was seen.

    judges: networks that could be loaded, by name. images: by renderer, of the objects ``before`` and ``after``
    (views, H, W, 3). logits: by (renderer, network, pipeline, ``before`` or ``after``), (views, classes). missing:
    why a renderer gave no images.
    """

    spec: JudgementSpec
    suite: Suite
    before: JudgedObject
    after: JudgedObject
    judges: Mapping[str, Judge]
    records: Sequence[JudgedNetwork]
    views: Sequence[View]
    size: tuple[int, int]
    engines: dict[str, EngineInfo] = field(default_factory=dict)
    images: dict[str, Mapping[str, Images]] = field(default_factory=dict)
    logits: dict[tuple[str, str, str, str], Logits] = field(default_factory=dict)
    missing: dict[str, str] = field(default_factory=dict)

    @cached_property
    def pair(self) -> ObjectPair:
        """The two objects."""
        return ObjectPair(self.before.obj, self.after.obj)

    def both(self, renderer: str, network: str, pipeline: str = AS_RENDERED) -> tuple[Logits, Logits] | None:
        """Logits before and after; ``None`` if the renderer or the network is missing."""
        cell = renderer, network, pipeline
        return (self.logits[*cell, "before"], self.logits[*cell, "after"]) if (*cell, "after") in self.logits else None


def manifest_of(judged: Judged, *, seconds: float) -> Manifest:
    """The manifest. ``seconds``: wall time of the judgement."""
    spec, suite = judged.spec, judged.suite
    manifest = Manifest(
        suite=spec.suite,
        label=spec.label,
        epsilon=spec.epsilon,
        before=judged.before.file,
        after=judged.after.file,
        networks=list(judged.records),
        renderers=[_renderer(judged, name) for name in suite.renderers],
        image_size=judged.size,
        seed=suite.seed,
        views=[view_record(view) for view in judged.views],
        findings=[],
        textures=texture_changes(*judged.pair.textures, epsilon=spec.epsilon),
        cells=[
            _cell(judged, renderer, network.name, pipeline)
            for renderer in suite.renderers
            for network in judged.records
            for pipeline in PIPELINES
        ],
        predictions=[
            _predictions(judged, renderer, network) for renderer in judged.engines for network in judged.judges
        ],
        seconds=round(seconds, 1),
        versions=versions(),
    )
    return manifest.model_copy(update={"findings": [*findings_of(manifest, judged.pair)]})


def view_record(view: View) -> ViewRecord:
    """A view in the words of the manifest."""
    return ViewRecord(**camera_and_light(view), centre=view.camera.centre, background=view.background)


def view_of(record: ViewRecord) -> View:
    """Inverse of ``view_record``."""
    camera = Camera(record.distance, record.azimuth, record.elevation, record.roll, record.centre)
    light = Light(*(getattr(record, f"light_{each.name}") for each in fields(Light)))
    return View(camera, light, record.background)


def _cell(judged: Judged, renderer: str, network: str, pipeline: str) -> Cell:
    both = judged.both(renderer, network, pipeline)
    accuracy = None if both is None else of_pair(judged.judges[network].accuracy(*both), judged.pair)
    return Cell(renderer=renderer, network=network, pipeline=pipeline, accuracy=accuracy)


def of_pair(accuracy: Accuracy, pair: ObjectPair) -> Accuracy:
    """``accuracy`` without the figures that two different objects do not have."""
    return accuracy if pair.is_one else accuracy.model_copy(update=dict.fromkeys(DROPS))


def _renderer(judged: Judged, name: str) -> JudgedRenderer:
    if name not in judged.engines:
        return JudgedRenderer(name=name, missing=judged.missing[name])
    visibility = visibility_in(judged.pair, judged.views, judged.images[name], epsilon=judged.spec.epsilon)
    return JudgedRenderer(name=name, engine=judged.engines[name], visibility=visibility)


def visibility_in(
    pair: ObjectPair, views: Sequence[View], images: Mapping[str, Images], *, epsilon: float | None
) -> Visibility:
    """Of the repaint in the images ``before`` and ``after`` of ``views``; null for two different objects."""
    if not pair.is_one:
        return Visibility()
    before, after = images["before"], images["after"]
    return visibility_of(*pair.textures, before, after, behind(views, {}, before.shape[1:3]), epsilon=epsilon)


def _predictions(judged: Judged, renderer: str, network: str) -> Predictions:
    both = judged.both(renderer, network)
    assert both is not None  # the renderer has images, and the network was loaded
    labels = judged.judges[network].labels
    classes = [logits.argmax(axis=1).tolist() for logits in both]
    found = [np.round(margins(logits, labels), 4).tolist() for logits in both]
    return Predictions(
        renderer=renderer,
        network=network,
        before=classes[0],
        after=classes[1],
        before_margins=found[0],
        after_margins=found[1],
    )


def findings_of(manifest: Manifest, pair: ObjectPair) -> Iterator[Finding]:
    """Findings about the two objects, the budget, and what is missing or rests on little."""
    yield from pair.findings()
    epsilon = manifest.epsilon
    for change in manifest.textures:
        if change.texels_beyond_epsilon and epsilon is not None:
            yield Finding(
                kind="epsilon",
                text=f"The texture {change.texture!r} exceeds the stated epsilon of {epsilon:g} "
                f"({levels_within(epsilon)} levels of 255): {change.texels_beyond_epsilon} of "
                f"{change.size[0] * change.size[1]} texels change by more, one by {change.max_levels} levels.",
            )
    for warning in paint_warnings(pair.before):
        yield Finding(kind="material", text=warning)
    for network in manifest.networks:
        if network.image_size not in (None, manifest.image_size):
            sizes = [" x ".join(map(str, size)) for size in (network.image_size, manifest.image_size) if size]
            yield Finding(
                kind="network",
                text=f"The network {network.name!r} takes images of {sizes[0]}; those of {sizes[1]} are resized.",
            )
    lacking = {network.name: network.missing for network in manifest.networks if network.missing is not None}
    for reason in dict.fromkeys(lacking.values()):
        names = ", ".join(repr(name) for name, why in lacking.items() if why == reason)
        yield Finding(kind="network", text=f"No figures of {names}: {reason}")
    for renderer in manifest.renderers:
        if renderer.missing is not None:
            yield Finding(kind="renderer", text=f"No figures in {renderer.name!r}: {renderer.missing}")
    for cell in manifest.cells:
        if cell.pipeline == AS_RENDERED and cell.accuracy is not None and (words := drop_warning(cell.accuracy)):
            yield Finding(kind="views", text=f"{cell.renderer}, {cell.network}: {words}")
