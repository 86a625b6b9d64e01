"""A job: one attack on an object's texture, judged in the target renderer.

prepare     target images of the unpainted object, their classes and saliency
calibrate   probes; sampling model of the target; the cheapest sufficient colour model
attack-NNN  some steps of the attack in the surrogate; before some of them, further views from the pool
judge       target images of the saved 8-bit texture; report
"""

import math
import time
from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cached_property, partial
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray

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
    saliency,
    saliency_masks,
    start,
)
from trompe_server.attack.search import SHOWN, SKIPPED, finished
from trompe_server.job.calibrations import JobCalibrations
from trompe_server.job.files import OPEN, JobFiles
from trompe_server.job.pool import GrowingPool
from trompe_server.job.protocol import VIEWS_AFTER, VIEWS_BEFORE, Artifacts, OnProgress, PhaseReport, numbered
from trompe_server.job.report import ReportData, saliency_views, worst, write_report
from trompe_server.job.setup import JobRenderer, JobSetup, open_setup
from trompe_server.judging.metrics import recognised
from trompe_server.library import Library
from trompe_server.pictures import heat_textures
from trompe_server.renderers import TargetRenderer
from trompe_server.storage.folders import Folder
from trompe_server.surrogate import AnySurrogate, Image8, Painted, Surrogate, joined, textures_of
from trompe_server.surrogate.calibration import Calibration
from trompe_shared.api import JobSpec, JobState, Progress
from trompe_shared.geometry import View
from trompe_shared.object3d import Object3D, encode_png

CHUNK: Final = 5
"""Attack steps per phase: the most that is lost when a worker dies."""

FEW: Final = "few_texels"
"""Name of the file with the texels chosen by ``keep``: one mask per texture, in their order."""

SHARES: Final = {"prepare": 0.15, "calibrate": 0.25, "attack": 0.45, "judge": 0.15}
"""Parts of the progress bar by kind of phase."""

DONE: Final = Progress(phase="judge", fraction=1.0)

PREVIEWING: Final = 0.03
"""Largest share of an attack's time that its previews take: on a large texture one takes as long as a step."""

RECENT: Final = 10
"""Number of the latest steps that tell how long one takes."""

AS_PREPARED: Final = 1.5
"""The last phase takes this many times as long as the first; measured: 0.8 to 1.9."""

Ask = Callable[[JobRenderer, Object3D, Sequence[View]], Image8]


def open_job(
    spec: JobSpec, *, library: Library, artifacts: Artifacts, target: TargetRenderer, **options: Any
) -> "TextureAttack":
    """The phases of the job ``spec``; other arguments as for ``open_setup``.

    Raises ``TrompeError`` for errors the user can fix.
    """
    began = time.perf_counter()
    setup = open_setup(spec, library=library, target=target, **options)
    return TextureAttack(spec, setup, artifacts, library.calibrations, began=began)


class TextureAttack:
    """One job; see the module's docstring. All that a phase leaves for later ones is in ``artifacts``.

    ``calibrations`` are shared with other jobs: a job with the same probes renders none. ``began``: when the opening of
    the job began, by ``time.perf_counter``; default: now.
    """

    def __init__(
        self,
        spec: JobSpec,
        setup: JobSetup,
        artifacts: Artifacts,
        calibrations: Folder,
        *,
        began: float | None = None,
    ) -> None:
        self.spec, self.setup, self.artifacts = spec, setup, artifacts
        self.files = JobFiles(artifacts, chunks=-(-spec.search.steps // CHUNK))
        paint = spec.paint
        self.budget = Budget(paint.epsilon, spec.alpha, paint.epsilon_view, paint.perceptual)
        self._calibrations = JobCalibrations(setup, spec.search, self.files, calibrations)
        self._counts: Counter[str] = Counter()
        self._between = time.perf_counter() if began is None else began
        self._stepped: deque[float] = deque(maxlen=RECENT)
        self._next_preview = 0.0
        self._scenes: dict[tuple[View, ...], tuple[AnySurrogate, Backgrounds | None, TexelMasks]] = {}

    def phases(self) -> list[str]:
        return self.files.phases

    def run(self, phase: str, on_progress: OnProgress) -> PhaseReport:
        kind, _, number = phase.partition("-")
        self._counts.clear()
        self._running = kind, time.perf_counter()
        self.files.note_seconds(f"{OPEN}-{phase}", self._running[1] - self._between)
        if kind == "attack":
            report = self._attack(int(number), on_progress)
        else:
            work = {"prepare": self._prepare, "calibrate": self._calibrate, "judge": self._judge}[kind]
            report = work(on_progress)
        self._between = time.perf_counter()
        self.files.note_seconds(phase, self._between - self._running[1])
        return replace(report, counts=dict(self._counts))

    def _seconds(self) -> dict[str, float]:
        """Seconds by kind of phase, up to now."""
        kind, began = self._running
        return self.files.seconds() | {kind: time.perf_counter() - began}

    def _prepare(self, on_progress: OnProgress) -> PhaseReport:
        setup = self.setup
        count = len(setup.views) + len(setup.held_out)
        ask = self._asker("prepare", count * len(setup.renderers), on_progress)
        self._render_all(VIEWS_BEFORE, setup.obj, ask)
        if setup.white_box:
            self.files.save("saliency", maps=self._saliency())
        if not any(self._recognised):
            return self._end_without_attack()
        _ = self._masks  # raises for a tau that leaves no pixel, before more images are rendered
        return PhaseReport(self._progress("prepare", 1.0))

    def _render_all(self, name: str, obj: Object3D, ask: Ask) -> None:
        """Save the images of own and held-out views of ``obj`` in each renderer under ``name``."""
        for number, renderer in enumerate(self.setup.renderers):
            own = ask(renderer, obj, renderer.shown(self.setup.views))
            held_out = ask(renderer, obj, renderer.shown(self.setup.held_out, held_out=True))
            self.files.save(numbered(name, number), own=own, held_out=held_out)

    def _saliency(self) -> NDArray[np.float16]:
        """Saliency of the attacked renderers' images (views, H, W): with tau of all, otherwise of those that the report
        shows, and zero elsewhere."""
        clean, count = self._clean, len(self.setup.views)
        shown = range(count) if self.spec.paint.tau is not None else saliency_views(self.setup)
        index = [number * count + view for number in range(len(self.setup.attacked)) for view in shown]
        maps = np.zeros(clean.shape[:3], np.float16)
        maps[index] = saliency(clean[index], self.setup.members, goal=self.setup.goal).numpy()
        return maps

    def _end_without_attack(self) -> PhaseReport:
        names = " or ".join(repr(self.setup.judge.class_name(label)) for label in self.setup.labels)
        hint = "" if self.spec.victim.queries is None else ", and that the .onnx file normalises its images"
        note = (
            f"{self.setup.classifier.name!r} recognises {names} in none of the {len(self._clean)} target views of the "
            f"unpainted object, so nothing can drop. Check `label`, `distance`, `elevation` and `background`{hint}."
        )
        public = write_report(self._seen(), self.artifacts, seconds=self._seconds, warnings=(note,))
        return PhaseReport(DONE, JobState.not_applicable, note, public)

    def _calibrate(self, on_progress: OnProgress) -> PhaseReport:
        attacked = self.setup.attacked
        # Five greys on every view and some trials; fewer if a cheaper model is good enough.
        ask = self._asker("calibrate", len(attacked) * (5 * len(self.setup.views) + 4), on_progress)
        for number, renderer in enumerate(attacked):
            self._calibrations.make(number, self._before(number)["own"], partial(ask, renderer))
        return PhaseReport(self._progress("calibrate", 1.0))

    def _attack(self, chunk: int, on_progress: OnProgress) -> PhaseReport:
        before = self.files.load_state(chunk, step=chunk * CHUNK) if chunk else start(self._textures)
        if not chunk:
            self._choose(on_progress)
        total, asked = self.spec.search.steps, self.setup.queries or 0
        before = self._looked(chunk, before, on_progress)
        steps = min(CHUNK, total - before.step)
        taken: list[Step] = []
        last = self._progress("attack", (before.step + steps) / total)

        def on_step(step: Step) -> None:
            nonlocal last
            taken.append(step)
            told = {"step": step.step + 1, "steps": total, "loss": step.loss, "fooled": step.fooled}
            left = self._left(total - step.step - 1, step.least_left)
            last = self._progress("attack", (step.step + 1) / total).model_copy(update=told | left)
            on_progress(last)

        after = self._ascend(before, steps, on_step)
        ended = after.step == total or self._ended(after)
        if ended:
            self.files.save_end(after)
        else:
            self.files.save_state(chunk + 1, after)
        if taken:
            self._preview(after)
        shown_before, shown = (int(each.memory.get(SHOWN, 0)) for each in (before, after))
        self._counts["attack_steps"] += len(taken)
        self._counts["classifier_images"] += shown - shown_before
        queries = (self.setup.queries or 0) - asked
        self.files.note_spent(chunk, steps=len(taken), evaluations=shown, queries=queries)
        return PhaseReport(last, then="judge" if ended else None)

    def _ended(self, state: AttackState) -> bool:
        """Whether no step is left, and no look at further views either."""
        return finished(state.memory, self.setup.goal) and not (self.setup.further and self._pool.due(state))

    def _looked(self, chunk: int, state: AttackState, on_progress: OnProgress) -> AttackState:
        """The state after a look at further views of the pool, if one is due."""
        if not self.setup.further:
            return state
        self._pool.load(chunk)
        if not self._pool.due(state):
            return state
        done = state.step / self.spec.search.steps
        ask = partial(self._asker("attack", math.inf, on_progress, done=done), self.setup.renderers[0])
        painted = self.budget.repaint(self.setup.obj, state.deltas)
        looked = self._pool.look(chunk, state, painted, ask)
        self._counts["classifier_images"] += int(looked.memory[SHOWN]) - int(state.memory.get(SHOWN, 0))
        return looked

    def _left(self, most: int, least: int) -> dict[str, float]:
        """Estimated seconds left, from the time of the latest steps: with ``most`` and with ``least`` further ones.

        The least ones skip safely won views.
        """
        self._stepped.append(time.perf_counter())
        if len(self._stepped) == 1:
            return {}
        each = (self._stepped[-1] - self._stepped[0]) / (len(self._stepped) - 1)
        work = most, least if least == most else least / (1 + SKIPPED)
        eta, least_eta = (round(steps * each + self._judge_seconds, 1) for steps in work)
        return {"eta_seconds": eta, "eta_least_seconds": least_eta}

    def _preview(self, state: AttackState) -> None:
        """Save a picture for spectators, if it is time: the first view of the texture, in surrogate and target."""
        began = time.perf_counter()
        if began < self._next_preview:
            return
        setup, painted = self.setup, self.budget.repaint(self.setup.obj, state.deltas)
        first, surrogate = setup.renderers[0], self._surrogates[0]
        texels = Painted(painted, surrogate.device).texels(surrogate.geometry)
        expected = surrogate.render(texels, 0)[0].permute(1, 2, 0).cpu().numpy()
        shown = first.target.render(painted, first.shown(setup.views[:1]), size=setup.size)[0]
        self._counts["target_renders"] += 1
        picture = np.concatenate([(255 * expected).round().astype(np.uint8), shown], 1)
        self.artifacts.write("preview.png", encode_png(picture))
        self._next_preview = began + (time.perf_counter() - began) / PREVIEWING

    def _ascend(self, state: AttackState, steps: int, on_step: Callable[[Step], None]) -> AttackState:
        setup, search, (surrogate, backgrounds, texels) = self.setup, self.spec.search, self._scene()
        return attack(
            state,
            self._textures,
            surrogate,
            setup.members,
            goal=setup.goal,
            budget=self.budget,
            steps=steps,
            total_steps=search.steps,
            optimiser=search.optimiser,
            masks=self._masks,
            texels=texels,
            views_per_step=self.spec.views_per_step * len(setup.attacked),
            backgrounds=backgrounds,
            pipeline=setup.pipeline,
            seed=search.seed,
            on_step=on_step,
        )

    def _scene(self) -> tuple[AnySurrogate, Backgrounds | None, TexelMasks]:
        """What the steps look at: all views so far, their backgrounds if several, the texels that may change."""
        added = self._pool.views if self.setup.further else ()
        if added not in self._scenes:
            parts = [*self._surrogates, *(self._pool.surrogates if added else ())]
            surrogate, backgrounds = joined(parts), self._backgrounds(added)
            self._scenes = {added: (surrogate, backgrounds, self._movable(surrogate))}
        return self._scenes[added]

    def _judge(self, on_progress: OnProgress) -> PhaseReport:
        setup = self.setup
        painted = self.budget.repaint(setup.obj, self.files.load_end().deltas)
        # The figures and the report take about as long as the images.
        count = len(setup.views) + len(setup.held_out)
        ask = self._asker("judge", 2 * count * len(setup.renderers), on_progress)
        self._render_all(VIEWS_AFTER, painted, ask)
        seen = self._seen(painted)
        headline = worst(seen)
        if headline.scores is not None:
            heat, views_shown = heat_textures(setup.obj.textures, headline.scores), saliency_views(setup)
            hot = setup.obj.with_textures(heat)
            renderer = headline.renderer
            heated = ask(renderer, hot, renderer.shown([setup.views[k] for k in views_shown]))
            seen[headline.number] = replace(headline, heated=heated)
        public = write_report(seen, self.artifacts, seconds=self._seconds)
        return PhaseReport(DONE, JobState.succeeded, None, public)

    def _seen(self, painted: Object3D | None = None) -> list[ReportData]:
        """The report's data of each renderer; ``painted``: after the attack."""
        count, scores = len(self.setup.views), None if painted is None else self._scores
        return [
            ReportData(
                spec=self.spec,
                setup=self.setup,
                number=number,
                before=self._before(number),
                maps=self._maps[number * count :][:count].numpy()
                if renderer.attacked and self._maps is not None
                else None,
                spent=self.files.spent(),
                after=None if painted is None else self.files.load(numbered(VIEWS_AFTER, number)),
                painted=painted,
                scores=scores,
                surrogate=self._surrogates[number] if painted is not None and renderer.attacked else None,
                calibration=self._found[number] if painted is not None and renderer.attacked else None,
            )
            for number, renderer in enumerate(self.setup.renderers)
        ]

    def _before(self, number: int) -> dict[str, Image8]:
        """Images of the unpainted object in the renderer ``number``."""
        return self.files.load(numbered(VIEWS_BEFORE, number))

    @property
    def _clean(self) -> Image8:
        """Images of the unpainted object's own views in all attacked renderers."""
        shown = [self._before(number)["own"] for number in range(len(self.setup.attacked))]
        return shown[0] if len(shown) == 1 else np.concatenate(shown)

    def _asker(self, phase: str, total: float, on_progress: OnProgress, *, done: float = 0.0) -> Ask:
        """Renders in a renderer and reports progress; ``total`` images complete the phase, of which a part is
        ``done``."""
        shown = 0

        def on_frame() -> None:
            nonlocal shown
            shown += 1
            self._counts["target_renders"] += 1
            on_progress(self._progress(phase, min(1.0, done + shown / total)))

        def ask(renderer: JobRenderer, obj: Object3D, views: Sequence[View]) -> Image8:
            return renderer.target.render(obj, views, size=self.setup.size, on_frame=on_frame)

        return ask

    def _progress(self, phase: str, share: float) -> Progress:
        """Progress of the whole job at ``share`` of ``phase``."""
        kinds = list(SHARES)
        done = sum(SHARES[kind] for kind in kinds[: kinds.index(phase)])
        left = round(self._judge_seconds - time.perf_counter() + self._running[1], 1) if phase == "judge" else 0.0
        return Progress(phase=phase, fraction=done + share * SHARES[phase], eta_seconds=left if left > 0 else None)

    @cached_property
    def _judge_seconds(self) -> float:
        """Estimated seconds of the last phase, from those of the first, which renders the same views."""
        return AS_PREPARED * self.files.seconds().get("prepare", 0.0)

    @cached_property
    def _textures(self) -> dict[str, torch.Tensor]:
        return textures_of(self.setup.obj, device=self.setup.device)

    @cached_property
    def _found(self) -> list[Calibration]:
        return self._calibrations.all()

    @cached_property
    def _surrogates(self) -> list[Surrogate]:
        """One for each attacked renderer."""
        return [
            self._calibrations.surrogate(number, calibration, self._before(number)["own"])
            for number, calibration in enumerate(self._found)
        ]

    @cached_property
    def _surrogate(self) -> AnySurrogate:
        """Of the first views."""
        return joined(self._surrogates)

    @cached_property
    def _pool(self) -> GrowingPool:
        return GrowingPool(self.setup, self.files, self._found[0], float(np.mean(self._recognised)))

    @cached_property
    def _maps(self) -> torch.Tensor | None:
        """Saliency of the attacked renderers' images (views, H, W); ``None`` for a classifier without gradients."""
        if not self.setup.white_box:
            return None
        return torch.from_numpy(self.files.load("saliency")["maps"].astype(np.float32))

    @cached_property
    def _masks(self) -> torch.Tensor | None:
        if self.spec.paint.tau is None or self._maps is None:
            return None
        return saliency_masks(self._maps, self.spec.paint.tau).to(self.setup.device)

    @cached_property
    def _scores(self) -> Mapping[str, NDArray[np.float32]] | None:
        """Saliency accumulated per texel."""
        if self._maps is None:
            return None
        scores = rank_texels(self._surrogate, self._textures, self._maps)
        return {name: score.detach().cpu().numpy() for name, score in scores.items()}

    def _backgrounds(self, added: Sequence[View] = ()) -> Backgrounds | None:
        """Backgrounds of a pool's views, drawn more often where the object is recognised better."""
        views = [*self.setup.views] * len(self.setup.attacked)
        backgrounds = None if self.spec.views.grid else self.setup.backgrounds([*views, *added])
        return None if backgrounds is None else backgrounds.weighted(self._recognised)

    @cached_property
    def _recognised(self) -> list[bool]:
        """Whether the object is recognised, for each image of the first views."""
        found: list[bool] = recognised(self.setup.classifier.predict(self._clean), self.setup.labels).tolist()
        return found

    def _movable(self, surrogate: AnySurrogate) -> TexelMasks:
        within = list(self.setup.within)
        if self.spec.paint.keep is not None:
            known = self.files.load(FEW)
            within.append({name: torch.from_numpy(known[str(k)]) for k, name in enumerate(self._textures)})
        return movable(surrogate, self.budget, self._masks, within=within)

    def _choose(self, on_progress: OnProgress) -> None:
        """Choose the few texels of ``keep``, and count the images shown before the first step, for them and for tau."""
        keep = self.spec.paint.keep
        few = 0 if keep is None else self._choose_texels(keep, on_progress)
        for_tau = len(self._clean) if self.spec.paint.tau is not None else 0
        shown = for_tau + few
        self._counts["classifier_images"] += shown
        self.files.note_shown_before(shown)

    def _choose_texels(self, keep: float, on_progress: OnProgress) -> int:
        """Find and save the share ``keep`` of all texels; returns the number of images shown."""
        setup = self.setup
        gradients = image_gradients(self._clean, setup.members, goal=setup.goal)
        few = few_texels(
            *(keep, self._textures, self._surrogate, setup.members, gradients),
            goal=setup.goal,
            budget=self.budget,
            within=setup.within,
            masks=self._masks,
            views_per_step=self.spec.views_per_step * len(setup.attacked),
            backgrounds=self._backgrounds(),
            pipeline=setup.pipeline,
            seed=self.spec.search.seed,
            on_step=lambda _: on_progress(self._progress("attack", 0.0)),
        )
        self.files.save(FEW, **{str(k): few.masks[name].cpu().numpy() for k, name in enumerate(self._textures)})
        return len(gradients) + few.evaluations
