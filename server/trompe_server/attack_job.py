"""The main job: one object, one classifier, one attack on the texture, judged in the target renderer.

prepare     the target's images of the unpainted object, what the classifier says of them, its saliency
calibrate   probes; how the target samples textures; the cheapest colour model that is good enough
attack-NNN  some steps of the attack in the surrogate
judge       the 8-bit texture goes back into the target; report
"""

import logging
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from functools import cached_property, partial
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray

from trompe_server.artifacts import Folder
from trompe_server.attack import (
    AttackState,
    Backgrounds,
    Budget,
    Step,
    TexelMasks,
    attack,
    few_texels,
    image_gradients,
    movable,
    rank_texels,
    saliency_masks,
    start,
)
from trompe_server.attack_report import saliency_views
from trompe_server.beyond_job import LightJob, VertexJob
from trompe_server.calibration_files import calibration_key, pack_calibration, unpack_calibration
from trompe_server.classifiers.metered import meter_network
from trompe_server.classifiers.network import NetworkClassifier
from trompe_server.classifiers.protocol import innermost
from trompe_server.library import Library
from trompe_server.meter import Meter
from trompe_server.phased_job import CHUNK, PROBE_STREAM, Image8, PhasedJob
from trompe_server.pipeline import VIEWS_BEFORE, Artifacts, OnProgress, PhaseReport
from trompe_server.reports import heat_textures
from trompe_server.scene import Scene, open_scene
from trompe_server.surrogate import Geometry, SamplingModel, Surrogate, prepare_geometry, textures_of
from trompe_server.surrogate.calibration import Calibration, build_surrogate, calibrate
from trompe_server.target import TargetRenderer
from trompe_shared.api import JobSpec
from trompe_shared.object3d import encode_png

__all__ = ["AttackJob", "open_pipeline"]

logger = logging.getLogger(__name__)

FEW: Final = "few_texels"
"""The file that says which texels ``keep`` chose: one mask for each texture, in their order."""


def open_pipeline(
    spec: JobSpec,
    *,
    library: Library,
    artifacts: Artifacts,
    target: TargetRenderer,
    device: str = "cpu",
    meter: Meter | None = None,
) -> PhasedJob:
    """The phases of the job that ``spec`` describes; ``meter`` counts what its networks are shown.

    Raises ``TrompeError`` for what the user can mend.
    """
    scene = open_scene(spec, library=library, target=target, device=device)
    if meter is not None:
        everything = map(innermost, (*scene.members, scene.classifier, *scene.judges))
        for each in {id(each): each for each in everything}.values():
            if isinstance(each, NetworkClassifier):
                meter_network(each.network, meter)
    if spec.attack_on == "light":
        return LightJob(spec, scene, artifacts)
    if spec.attack_on == "vertices":
        return VertexJob(spec, scene, artifacts)
    return AttackJob(spec, scene, artifacts, library.calibrations)


class AttackJob(PhasedJob):
    """One attack on a texture; see the head of this module.

    ``calibrations`` are kept for other jobs: one that would ask the target the same questions asks none.
    """

    def __init__(self, spec: JobSpec, scene: Scene, artifacts: Artifacts, calibrations: Folder) -> None:
        super().__init__(spec, scene, artifacts)
        self.calibrations = calibrations
        self._geometry: Future[Geometry] | None = None
        self.budget = Budget(spec.epsilon, spec.alpha, spec.epsilon_view)

    def _prepare(self, on_progress: OnProgress) -> PhaseReport:
        report = super()._prepare(on_progress)
        if report.state is None:
            _ = self._masks  # a tau that leaves nothing is told before more is asked
        return report

    def _calibrate(self, on_progress: OnProgress) -> PhaseReport:
        if not self.files.has_calibration():
            clean = self.files.load(VIEWS_BEFORE)["own"]
            name = f"{self._calibration_key(clean)}.npz"
            found = self._known_calibration(name)
            if found is None:
                found = self._ask_the_target(clean, on_progress)
            packed = pack_calibration(found)
            self.files.save_calibration(packed)
            if found.renders:
                self.calibrations.write(name, packed)
        return PhaseReport(self._progress("calibrate", 1.0))

    def _calibration_key(self, clean: Image8) -> str:
        scene, spec = self.scene, self.spec
        return calibration_key(scene.obj, scene.views, clean, wanted=spec.surrogate, seed=spec.seed)

    def _known_calibration(self, name: str) -> Calibration | None:
        """What an earlier job found out by the same questions; a damaged file counts as none."""
        if not self.calibrations.exists(name):
            return None
        try:
            known = unpack_calibration(self.calibrations.read(name))
        except (ValueError, OSError):
            logger.warning("the stored calibration %s is damaged; the target is asked again", name)
            return None
        self.calibrations.touch(name)
        return replace(known, renders=0, reason=f"{known.reason} (known from an earlier job)")

    def _ask_the_target(self, clean: Image8, on_progress: OnProgress) -> Calibration:
        scene = self.scene
        # Five greys on every view and some trials; fewer when the cheaper models do.
        ask = self._asker("calibrate", 5 * len(scene.views) + 4, on_progress)
        return calibrate(
            scene.obj,
            scene.views,
            clean,
            ask,
            wanted=self.spec.surrogate,
            generator=np.random.default_rng([self.spec.seed, PROBE_STREAM]),
            backdrops=scene.backdrops,
            on_sampling=self._prepare_beside,
        )

    def _prepare_beside(self, sampling: SamplingModel) -> None:
        """Rasterise all views while the renderer is busy with the probes."""
        scene = self.scene
        executor = ThreadPoolExecutor(1, thread_name_prefix="rasterise")
        prepare = partial(
            prepare_geometry, scene.obj, scene.views, size=scene.size, sampling=sampling, device=scene.device
        )
        self._geometry = executor.submit(prepare)
        executor.shutdown(wait=False)

    def _attack(self, chunk: int, on_progress: OnProgress) -> PhaseReport:
        before = self.files.load_state(chunk, step=chunk * CHUNK) if chunk else start(self._textures)
        if not chunk:
            self._choose(on_progress)
        steps = min(CHUNK, self.spec.steps - before.step)
        last, taken, asked = (
            self._progress("attack", (before.step + steps) / self.spec.steps),
            [],
            self.scene.queries or 0,
        )

        def on_step(step: Step) -> None:
            nonlocal last
            taken.append(step)
            last = self._step_progress(step.step + 1, loss=step.loss, fooled=step.fooled)
            on_progress(last)

        after = self._ascend(before, steps, on_step)
        self.files.save_state(chunk + 1, after)
        self._show(after)
        if taken:
            queries = (self.scene.queries or 0) - asked
            self.files.note_spent(chunk, steps=len(taken), evaluations=taken[-1].evaluations, queries=queries)
        return PhaseReport(last)

    def _show(self, state: AttackState) -> None:
        """Keep a picture for those who watch: the first view as it is now, in the surrogate and in the target."""
        scene, painted = self.scene, self.budget.repaint(self.scene.obj, state.deltas)
        texels = self._surrogate.texels(textures_of(painted, device=scene.device))
        with torch.no_grad():
            expected = self._surrogate.render(texels, 0)[0].permute(1, 2, 0).cpu().numpy()
        shown = scene.target.render(painted, scene.views[:1], size=scene.size)[0]
        self.artifacts.write(
            "preview.png", encode_png(np.concatenate([(255 * expected).round().astype(np.uint8), shown], 1))
        )

    def _ascend(self, state: AttackState, steps: int, on_step: Callable[[Step], None]) -> AttackState:
        scene, masks = self.scene, self._masks
        return attack(
            state,
            self._textures,
            self._surrogate,
            scene.shown,
            goal=scene.goal,
            budget=self.budget,
            steps=steps,
            total_steps=self.spec.steps,
            optimiser=self.spec.optimiser,
            restarts=self.spec.restarts,
            masks=masks,
            texels=self._movable,
            views_per_step=self.spec.n_views_per_step,
            backgrounds=self._backgrounds,
            seed=self.spec.seed,
            on_step=on_step,
        )

    def _judge(self, on_progress: OnProgress) -> PhaseReport:
        scene = self.scene
        deltas = self.files.load_state(self.files.chunks, step=self.spec.steps).deltas
        painted = self.budget.repaint(scene.obj, deltas)
        ask = self._show_judges(painted, scene.views, scene.held_out, on_progress)
        hot = None
        if self._scores is not None:
            heated = scene.obj.with_textures(heat_textures(scene.obj.textures, _numpy(self._scores)))
            hot = ask(heated, [scene.views[index] for index in saliency_views(scene)])
        evidence = replace(
            self._seen(),
            painted=painted,
            scores=None if self._scores is None else _numpy(self._scores),
            hot=hot,
            surrogate=self._surrogate,
            calibration=self._calibration,
        )
        return self._report(evidence)

    @cached_property
    def _textures(self) -> dict[str, torch.Tensor]:
        return textures_of(self.scene.obj, device=self.scene.device)

    @cached_property
    def _calibration(self) -> Calibration:
        return self.files.load_calibration()

    @cached_property
    def _surrogate(self) -> Surrogate:
        scene, clean = self.scene, self.files.load(VIEWS_BEFORE)["own"]
        geometry = self._geometry.result() if self._geometry is not None else None
        return build_surrogate(
            self._calibration,
            scene.obj,
            scene.views,
            clean,
            geometry=geometry,
            backdrops=scene.backdrops,
            device=scene.device,
        )

    @cached_property
    def _maps(self) -> torch.Tensor | None:
        """Saliency of the target's images (views, H, W), by the job's scope; ``None`` where the classifier gives no
        gradients."""
        if not self.scene.white_box:
            return None
        return torch.from_numpy(self.files.load("saliency")["maps"].astype(np.float32))

    @cached_property
    def _masks(self) -> torch.Tensor | None:
        if self.spec.tau is None or self._maps is None:
            return None
        return saliency_masks(self._maps, self.spec.tau).to(self.scene.device)

    @cached_property
    def _scores(self) -> Mapping[str, torch.Tensor] | None:
        """Saliency accumulated per texel."""
        return None if self._maps is None else rank_texels(self._surrogate, self._textures, self._maps)

    @cached_property
    def _backgrounds(self) -> Backgrounds | None:
        """What a pool's views are set in front of, the more often the better the object is recognised there."""
        backgrounds = self.scene.backgrounds if self.spec.pool else None
        if backgrounds is None:
            return None
        said = self.scene.classifier.predict(self.files.load(VIEWS_BEFORE)["own"]).argmax(axis=1)
        return backgrounds.by_need((said == self.scene.label).tolist())

    @cached_property
    def _movable(self) -> TexelMasks:
        within = list(self.scene.within)
        if self.spec.keep is not None:
            known = self.files.load(FEW)
            within.append({name: torch.from_numpy(known[str(k)]) for k, name in enumerate(self._textures)})
        return movable(self._surrogate, self.budget, self._masks, within=within)

    def _choose(self, on_progress: OnProgress) -> None:
        """Find the few texels, once for all steps, and note how many images it took to choose them, the pixels and the
        backgrounds: each view once for its saliency, and once for what it is taken for in front of its own background.
        """
        spec, looks = self.spec, (self.spec.tau is not None) + (self._backgrounds is not None)
        few = 0 if spec.keep is None else self._choose_texels(spec.keep, on_progress)
        self.files.note_shown_before(looks * len(self.scene.views) + few)

    def _choose_texels(self, keep: float, on_progress: OnProgress) -> int:
        """Find and keep the share ``keep`` of all texels; gives how many images it took."""
        scene = self.scene
        gradients = image_gradients(self.files.load(VIEWS_BEFORE)["own"], scene.members, goal=scene.goal)
        few = few_texels(
            *(keep, self._textures, self._surrogate, scene.shown, gradients),
            goal=scene.goal,
            budget=self.budget,
            within=scene.within,
            masks=self._masks,
            views_per_step=self.spec.n_views_per_step,
            backgrounds=self._backgrounds,
            seed=self.spec.seed,
            on_step=lambda _: on_progress(self._progress("attack", 0.0)),
        )
        self.files.save(FEW, **{str(k): few.masks[name].cpu().numpy() for k, name in enumerate(self._textures)})
        return len(gradients) + few.evaluations


def _numpy(scores: Mapping[str, torch.Tensor]) -> dict[str, NDArray[np.float32]]:
    return {name: score.detach().cpu().numpy() for name, score in scores.items()}
