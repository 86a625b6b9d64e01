"""Input of the report."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from trompe_server.job.files import Spent
from trompe_server.job.setup import JobRenderer, JobSetup
from trompe_server.judging.metrics import agreement
from trompe_server.surrogate import Surrogate
from trompe_server.surrogate.calibration import Calibration
from trompe_server.surrogate.fidelity import ViewFit, compare_views
from trompe_shared.api import Accuracy, JobSpec
from trompe_shared.geometry import View
from trompe_shared.object3d import Object3D

Images = Mapping[str, NDArray[np.uint8]]
"""Target images (views, H, W, 3) of the ``own`` (attacked) and the ``held_out`` views."""


@dataclass(frozen=True)
class ReportData:
    """Input of the report: one renderer's images. Fields of the attack are ``None`` if there was none (n.a.).

    number: of the renderer. maps: saliency of the own views (views, H, W). scores: saliency accumulated per texel (H,
    W). heated: target images, of ``saliency_views``, of the object painted with ``scores`` as heat. All three are
    ``None`` without gradients.
    """

    spec: JobSpec
    setup: JobSetup
    number: int
    before: Images
    maps: NDArray[np.float32] | None
    spent: Spent
    after: Images | None = None
    painted: Object3D | None = None
    scores: Mapping[str, NDArray[np.float32]] | None = None
    heated: NDArray[np.uint8] | None = None
    surrogate: Surrogate | None = None
    calibration: Calibration | None = None

    @property
    def renderer(self) -> JobRenderer:
        return self.setup.renderers[self.number]

    @cached_property
    def target(self) -> Accuracy:
        """Accuracy on the own views."""
        return self._accuracy("own")

    @cached_property
    def held_out(self) -> Accuracy | None:
        """Accuracy on the held-out views, if any."""
        return self._accuracy("held_out") if self.setup.held_out else None

    @cached_property
    def predicted(self) -> Accuracy | None:
        """Accuracy on the surrogate's images of the own views; ``None`` without an attack."""
        if self._expected is None:
            return None
        return self.setup.judge.accuracy(*self._expected, distinct=self.distinct("own"))

    @cached_property
    def agreement(self) -> dict[str, float | None] | None:
        """Agreement of surrogate and target on the own views; ``None`` without an attack."""
        if self._expected is None or self.logits_after is None:
            return None
        shown = self.logits_before["own"], self.logits_after["own"], self._expected[1]
        return agreement(*shown, self.setup.labels)

    @cached_property
    def _expected(self) -> tuple[NDArray[np.float32], NDArray[np.float32]] | None:
        """Logits of the surrogate's images of the own views, before and after; ``None`` without an attack."""
        if self.surrogate is None or self.painted is None:
            return None
        predict, clean = self.setup.classifier.predict, self.surrogate.images(self.setup.obj)
        anchored = np.array_equal(clean, self.before["own"])
        before = self.logits_before["own"] if anchored else predict(clean)
        return before, predict(self.surrogate.images(self.painted))

    def _accuracy(self, views: str) -> Accuracy:
        after = None if self.logits_after is None else self.logits_after[views]
        return self.setup.judge.accuracy(self.logits_before[views], after, distinct=self.distinct(views))

    def distinct(self, views: str) -> int:
        """Number of distinct views."""
        return len(distinct_views(self.setup.views if views == "own" else self.setup.held_out))

    @cached_property
    def logits_before(self) -> Mapping[str, NDArray[np.float32]]:
        """Logits of the attacked classifier by set of views."""
        return {name: self.setup.classifier.predict(images) for name, images in self.before.items()}

    @cached_property
    def logits_after(self) -> Mapping[str, NDArray[np.float32]] | None:
        """The same for the repainted object."""
        if self.after is None:
            return None
        return {name: self.setup.classifier.predict(images) for name, images in self.after.items()}

    @cached_property
    def fits(self) -> Sequence[ViewFit | None]:
        """Agreement of surrogate and target in each own view; empty without an attack."""
        if self.surrogate is None or self.painted is None or self.after is None:
            return ()
        return compare_views(self.surrogate, self.setup.obj, self.before["own"], self.painted, self.after["own"])


def distinct_views(views: Sequence[View]) -> NDArray[np.int64]:
    """Indices of the distinct views: the paper's grid has azimuth 0 twice, as 0 and as 360."""
    seen: dict[View, int] = {}
    for index, view in enumerate(views):
        seen.setdefault(replace(view, camera=replace(view.camera, azimuth=view.camera.azimuth % 360)), index)
    return np.array(list(seen.values()))
