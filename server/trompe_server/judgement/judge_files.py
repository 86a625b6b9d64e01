"""Judge one model file against another: the object of the second is said to be that of the first, repainted.

Whatever is missing or does not fit becomes a finding, and the rest is judged.
"""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache, cached_property, partial
from typing import Final

import numpy as np
from numpy.typing import NDArray

from trompe_server.attack import ViewDistribution
from trompe_server.job.protocol import Artifacts, OnProgress
from trompe_server.job.setup import HELD_OUT_STREAM, drawn_views, noise_numbers
from trompe_server.judgement.manifest import PIPELINES, Judged
from trompe_server.judgement.sources import JudgedObject, Sources
from trompe_server.judgement.suites import Suite, suite_of
from trompe_server.judgement.work import Kept, Timed, key_of
from trompe_server.judging.judge import Judge
from trompe_server.renderers import TargetRenderer
from trompe_server.spec.checks import check_indices
from trompe_server.spec.framing import Framing, framing_of
from trompe_shared.api import JudgedNetwork, JudgementSpec, ViewOptions
from trompe_shared.engine import EngineInfo
from trompe_shared.errors import ClassifierError, LabelError, RendererError, RendererLostError, SpecError
from trompe_shared.geometry import View

SHARE: Final = 10
"""Images between two saves."""

IMAGE_SIZE: Final = (224, 224)
"""Of the images if no network can be loaded."""

Images = NDArray[np.uint8]


def judge_files(spec: JudgementSpec, sources: Sources, *, kept: Artifacts, on_progress: OnProgress) -> Judged:
    """Judge what ``spec`` names in ``sources``. A stopped judgement goes on with what is in ``kept``.

    Raises ``ObjectError`` if one of the two files cannot be read, and ``SpecError`` for two networks of one name and
    an unknown suite.
    """
    suite = suite_of(spec, renderer=sources.renderer)
    before, after = sources.object(spec.before, "before"), sources.object(spec.after, "after")
    judges, records = _networks(spec, suite, sources)
    size = suite.image_size or next((judge.network.image_size for judge in judges.values()), IMAGE_SIZE)
    framing = framing_of(
        before.obj, ViewOptions(distance=spec.distance, elevation=spec.elevation), shipped=before.shipped
    )
    views = sampled(suite.views, suite.seed, framing, background=spec.background)
    judged = Judged(spec, suite, before, after, judges, records, views, size)
    _Run(judged, sources, Kept(kept), on_progress).run()
    return judged


def sampled(count: int, seed: int, framing: Framing, *, background: str) -> list[View]:
    """Random views: those of a job's held-out ones if the seed is the same."""
    cameras = ViewDistribution(framing.distance, framing.elevation, centre=framing.centre)
    return [*drawn_views(cameras, [background], count, seed=seed, stream=HELD_OUT_STREAM)]


def noisy(views: Sequence[View], engine: EngineInfo, seed: int) -> Sequence[View]:
    """``views`` with the number of their noise, as a job's held-out ones."""
    _, noise = noise_numbers(engine, seed)
    return [replace(view, noise=noise) for view in views]


def _networks(spec: JudgementSpec, suite: Suite, sources: Sources) -> tuple[dict[str, Judge], list[JudgedNetwork]]:
    """The networks that can judge, by name, and the records of all."""
    judges, records = dict[str, Judge](), list[JudgedNetwork]()
    for reference in suite.networks:
        try:
            judge, record = sources.network(reference, spec.label)
            check_indices(spec.label, next(iter(judges.values()), judge).network, [judge.network])
        except (ClassifierError, LabelError, SpecError) as error:
            record = JudgedNetwork(name=reference, reference=reference, missing=str(error))
        else:
            if record.name in judges:
                raise SpecError(f"Two networks are called {record.name!r}; rename the file of one.")
            judges[record.name] = judge
        records.append(record)
    return judges, records


@dataclass(frozen=True)
class _Run:
    judged: Judged
    sources: Sources
    kept: Kept
    on_progress: OnProgress

    def run(self) -> None:
        """Look at everything, and note it in ``judged``."""
        for name in self.judged.suite.renderers:
            try:
                self._again_if_lost(name)
            except (RendererError, SpecError) as error:  # no such renderer, or several
                self.judged.missing[name] = str(error)
                self._timed.skip(_rendering(name), *(_showing(name, network) for network in self.judged.judges))

    def _again_if_lost(self, name: str) -> None:
        """Look in a renderer, once more if it was lost: its supervisor restarts it, and finished work is kept."""
        try:
            self._in_renderer(name)
        except RendererLostError:
            self._timed.left[_rendering(name)] = 2 * len(self.judged.views)
            self._in_renderer(name)

    @cached_property
    def _timed(self) -> Timed:
        pairs, renderers = 2 * len(self.judged.views), self.judged.suite.renderers
        left = Counter({_rendering(name): pairs for name in renderers})
        left |= Counter({_showing(name, to): pairs * len(PIPELINES) for name in renderers for to in self.judged.judges})
        return Timed(left, self.on_progress)

    def _in_renderer(self, name: str) -> None:
        objects = {"before": self.judged.before, "after": self.judged.after}
        with self.sources.running(name) as target:
            engine, views = target.engine, noisy(self.judged.views, target.engine, self.judged.suite.seed)
            images = {kind: self._images(name, target, each, views) for kind, each in objects.items()}
        self.judged.engines[name], self.judged.images[name] = engine, images
        for pipeline in PIPELINES:
            for kind, each in objects.items():
                self._show(name, pipeline, kind, self._key(each, engine, views))

    def _key(self, each: JudgedObject, engine: EngineInfo, views: Sequence[View]) -> str:
        """Of images of some views."""
        return key_of(each.file.sha256, asdict(engine), [asdict(view) for view in views], self.judged.size)

    def _images(self, name: str, target: TargetRenderer, each: JudgedObject, views: Sequence[View]) -> Images:
        parts = []
        for start in range(0, len(views), SHARE):
            share = views[start : start + SHARE]
            key = self._key(each, target.engine, share)
            with self._timed.step(_rendering(name), len(share), kept=self.kept.has(key)):
                parts.append(self.kept.array(key, partial(target.render, each.obj, share, size=self.judged.size)))
        return np.concatenate(parts)

    def _show(self, renderer: str, pipeline: str, kind: str, key: str) -> None:
        """Show the images of one object, through a pipeline, to all networks."""
        through, images = PIPELINES[pipeline], self.judged.images[renderer][kind]
        shown = cache(lambda: images if through is None else through.shown(images))
        for record in self.judged.records:
            if (judge := self.judged.judges.get(record.name)) is None:
                continue
            mine = key_of(key, pipeline, str(through), record.sha256)
            with self._timed.step(_showing(renderer, record.name), len(images), kept=self.kept.has(mine)):
                logits = self.kept.array(mine, partial(_logits, judge, shown))
            self.judged.logits[renderer, record.name, pipeline, kind] = logits


def _logits(judge: Judge, shown: Callable[[], Images]) -> NDArray[np.float32]:
    return judge.network.predict(shown())


def _rendering(renderer: str) -> str:
    return f"rendering in {renderer}"


def _showing(renderer: str, network: str) -> str:
    return f"showing images of {renderer} to {network}"
