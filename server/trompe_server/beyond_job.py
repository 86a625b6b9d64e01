"""Jobs that leave the texture as it is: the light looked for in the target, and vertices that move along gradients.

Light: each chunk tries some places of the light in the target, on views that are not judged. What came out is the best
of them; the attack's own views and the held-out ones are looked at again under that light.
Vertices: ``calibrate`` asks for each view under ambient and under main light alone; each chunk takes some steps.
"""

from collections.abc import Mapping
from dataclasses import asdict, replace
from functools import cached_property, partial
from typing import Any, ClassVar, Final

import numpy as np
import torch
from jaxtyping import UInt8

from trompe_server.attack.beyond import (
    LightProbes,
    LightRanges,
    LightTrial,
    Relief,
    Shape,
    VertexBudget,
    VertexState,
    VertexStep,
    find_light,
    light_map,
    load_light,
    load_vertices,
    move_vertices,
    probe_light,
    save_light,
    save_vertices,
    shape_of,
)
from trompe_server.attack_report import Beyond
from trompe_server.calibration_files import pack_calibration
from trompe_server.phased_job import CHUNK, PROBE_STREAM, PhasedJob
from trompe_server.pipeline import VIEWS_BEFORE, OnProgress, PhaseReport
from trompe_server.surrogate import behind
from trompe_server.surrogate.calibration import Calibration, calibrate
from trompe_shared.api import LightFound, VerticesMoved
from trompe_shared.object3d import Object3D

__all__ = ["LightJob", "VertexJob"]

PROBES: Final = "light_probes"
SAMPLED: Final = 12
"""Views by which it is found out how the target samples textures."""


class LightJob(PhasedJob):
    """Where the main light fools most; see the head of this module."""

    shares: ClassVar[Mapping[str, float]] = {"prepare": 0.15, "attack": 0.7, "judge": 0.15}

    def _attack(self, chunk: int, on_progress: OnProgress) -> PhaseReport:
        scene, spec = self.scene, self.spec
        done = chunk * CHUNK
        tried = self.files.load_checkpoint(chunk, load_light, step=done).trials if chunk else ()
        last = self._progress("attack", done / spec.steps)

        def on_trial(trial: LightTrial) -> None:
            nonlocal done, last
            done += 1
            last = self._step_progress(done, loss=trial.loss, fooled=trial.fooled)
            on_progress(last)

        found = find_light(
            partial(scene.target.render, scene.obj, size=scene.size),
            scene.lights_tried_on,
            scene.members,
            goal=scene.goal,
            ranges=LightRanges(**dict(spec.sun)),
            n_views=len(scene.lights_tried_on),
            places=spec.steps,
            seed=spec.seed,
            tried=tried,
            until=min(done + CHUNK, spec.steps),
            on_trial=on_trial,
        )
        self.files.save_checkpoint(chunk + 1, save_light(found))
        new = found.step - len(tried)
        queries = 0 if scene.white_box else new * len(found.asked)
        self.files.note_spent(chunk, steps=new, evaluations=found.renders, queries=queries)
        return PhaseReport(last)

    def _judge(self, on_progress: OnProgress) -> PhaseReport:
        scene, found = self.scene, self.files.load_checkpoint(self.files.chunks, load_light, step=self.spec.steps)
        place = found.place
        self._show_judges(scene.obj, place.light_up(scene.views), place.light_up(scene.held_out), on_progress)
        fooled = next(trial.fooled for trial in found.trials if trial.place == place)
        beyond = Beyond(
            f"light from azimuth {place.azimuth:.0f}, elevation {place.elevation:.0f}",
            {
                "surrogate_model": "none",
                "surrogate_reason": f"the target itself was asked, on {len(found.asked)} views that judge nothing",
                "probe_renders": found.renders,
                "light": LightFound(**asdict(place), fooled=fooled, tried_on=len(found.asked)),
            },
            {"light_map.png": light_map(found)},
        )
        return self._report(replace(self._seen(), beyond=beyond))


class VertexJob(PhasedJob):
    """How vertices that move a little fool most; see the head of this module."""

    def _calibrate(self, on_progress: OnProgress) -> PhaseReport:
        scene, clean = self.scene, self.files.load(VIEWS_BEFORE)["own"]
        ask = self._asker("calibrate", 2 * len(scene.views) + 4 * SAMPLED, on_progress)
        probes = probe_light(partial(ask, scene.obj), scene.views)
        self.files.save(PROBES, ambient=probes.ambient, main=probes.main)
        few = slice(None, None, -(-len(scene.views) // SAMPLED))
        found = calibrate(
            scene.obj,
            scene.views[few],
            clean[few],
            ask,
            wanted="calibrated",
            generator=np.random.default_rng([self.spec.seed, PROBE_STREAM]),
            backdrops=scene.backdrops,
        )
        self.files.save_calibration(pack_calibration(found))
        return PhaseReport(self._progress("calibrate", 1.0))

    def _attack(self, chunk: int, on_progress: OnProgress) -> PhaseReport:
        scene, spec, done = self.scene, self.spec, chunk * CHUNK
        before = self.files.load_checkpoint(chunk, load_vertices, step=done) if chunk else VertexState.of(self._shape)
        steps = min(CHUNK, spec.steps - before.step)
        last = self._progress("attack", done / spec.steps)

        def on_step(step: VertexStep) -> None:
            nonlocal last
            last = self._step_progress(step.step + 1, loss=step.won, fooled=step.fooled)
            on_progress(last)

        after = move_vertices(
            before,
            self._relief,
            scene.members,
            goal=scene.goal,
            budget=self._budget,
            steps=steps,
            total_steps=spec.steps,
            views_per_step=spec.n_views_per_step,
            seed=spec.seed,
            on_step=on_step,
        )
        self.files.save_checkpoint(chunk + 1, save_vertices(after))
        self.files.note_spent(chunk, steps=steps, evaluations=after.step * spec.n_views_per_step, queries=0)
        return PhaseReport(last)

    def _judge(self, on_progress: OnProgress) -> PhaseReport:
        scene = self.scene
        state = self.files.load_checkpoint(self.files.chunks, load_vertices, step=self.spec.steps)
        moved = self._budget.reshape(scene.obj, self._shape, state)
        self._show_judges(moved, scene.views, scene.held_out, on_progress)
        figures = self._calibration_figures() | {"vertices": _moved(scene.obj, moved)}
        words = f"vertices moved by at most {self.spec.vertex_budget:.1%} of the radius"
        beyond = Beyond(words, figures, predicted=self._predicted(state))
        return self._report(replace(self._seen(), painted=moved, beyond=beyond))

    def _calibration_figures(self) -> dict[str, Any]:
        return {
            "surrogate_model": "relief",
            "surrogate_reason": "the target's own images, carried along and relit as the surface moves",
            "probe_renders": self._calibration.renders + 2 * len(self.scene.views),
        }

    @torch.no_grad()
    def _predicted(self, state: VertexState) -> UInt8[np.ndarray, "views H W 3"]:
        """What the attack's model shows of the own views after it."""
        relief, shape = self._relief, self._shape
        places = shape.moved(self._budget.heights(self.scene.obj, shape, state.shares))
        normals, images = shape.shaded(places), np.zeros_like(relief.clean)
        for view in range(len(images)):
            shown = relief.image(relief.at(places, view), view, places, normals)
            images[view] = shown.mul(255).round().byte().permute(1, 2, 0).numpy()
        return images

    @cached_property
    def _budget(self) -> VertexBudget:
        return VertexBudget(self.spec.vertex_budget)

    @cached_property
    def _shape(self) -> Shape:
        return shape_of(self.scene.obj)

    @cached_property
    def _calibration(self) -> Calibration:
        return self.files.load_calibration()

    @cached_property
    def _relief(self) -> Relief:
        scene = self.scene
        return Relief(
            scene.obj,
            self._shape,
            scene.views,
            self.files.load(VIEWS_BEFORE)["own"],
            LightProbes(**self.files.load(PROBES)),
            behind(scene.views, scene.backdrops, scene.size),
            self._calibration.sampling,
        )


def _moved(before: Object3D, after: Object3D) -> VerticesMoved:
    """How far the corners of ``after``'s faces are from those of ``before``."""
    places = [np.concatenate([part.vertices[part.faces] for part in obj.parts]) for obj in (before, after)]
    apart = np.linalg.norm(places[1].astype(np.float64) - places[0], axis=-1)
    largest = float(apart.max())
    return VerticesMoved(largest=largest, largest_share=largest / before.radius, mean=float(apart.mean()))
