"""Jobs on the light and on vertices with the real renderer and the shipped classifier: what their user relies on."""

import io
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from trompe_server.array_files import unpack_arrays
from trompe_server.artifacts import LocalArtifacts
from trompe_server.attack_job import open_pipeline
from trompe_server.formats import read_object
from trompe_server.library import Library
from trompe_server.pipeline import PhaseReport
from trompe_server.scene import Scene, open_scene
from trompe_server.target import SailenvTarget
from trompe_shared.api import Accuracy, JobSpec, JobState, Result
from trompe_shared.geometry import View
from trompe_shared.object3d import Object3D, load_object

FEW = {"object": "mug", "label": "mug", "classifier": "tiny", "pool": 3, "held_out": 2}


class Finished:
    """A job that was run to its end: its files, its result, and the scene that it was about."""

    def __init__(self, target: SailenvTarget, folder: Path, **options: Any) -> None:
        spec = JobSpec.model_validate(FEW | options)
        self.library, self.folder, self.target = Library(folder / "library"), folder / "job", target
        artifacts = LocalArtifacts(self.folder)
        job = open_pipeline(spec, library=self.library, artifacts=artifacts, target=target)
        self.report: PhaseReport = [job.run(phase, lambda _: None) for phase in job.phases()][-1]
        self.result = Result.model_validate_json(self.read("result.json"))
        self.scene: Scene = open_scene(spec, library=self.library, target=target)

    def read(self, name: str) -> bytes:
        return (self.folder / name).read_bytes()

    def judged(self, obj: Object3D, views: Sequence[View], name: str, told: Accuracy | None) -> None:
        """What the job told of ``views`` is what the target shows in them, and what the classifier says of that."""
        shown = self.target.render(obj, views, size=self.scene.size)
        np.testing.assert_array_equal(unpack_arrays(self.read("views_after.npz"))[name], shown)
        assert told is not None
        assert told.views == len(views)
        assert told.a_after == (self.scene.classifier.predict(shown).argmax(axis=1) == self.scene.label).mean()

    def can_be_opened(self, *more: str) -> None:
        """The pictures and models that the job made are among its files, and are what their names say."""
        assert self.report.state is JobState.succeeded
        assert {"contact_sheet.png", "difference.png", "views_before.npz", *more} <= set(self.report.public)
        for name in self.report.public:
            if name.endswith(".png"):
                with Image.open(io.BytesIO(self.read(name))) as picture:
                    assert min(picture.size) > 100


def corners(obj: Object3D) -> NDArray[np.float64]:
    """(faces, 3, 3), metres."""
    return np.concatenate([part.vertices[part.faces] for part in obj.parts]).astype(np.float64)


def test_a_light_is_found_in_its_range_judged_in_the_target_and_leaves_the_object_alone(
    target: SailenvTarget, mug: Object3D, tmp_path: Path
) -> None:
    sun = {"azimuth": (-60.0, 20.0), "elevation": (20.0, 50.0), "intensity": (0.5, 2.0)}
    job = Finished(target, tmp_path, attack_on="light", steps=8, views_per_step=2, sun=sun)
    job.can_be_opened("light_map.png")
    found, scene = job.result.light, job.scene
    assert found is not None
    for name, (low, high) in sun.items():
        assert low <= getattr(found, name) <= high
    place = {name: getattr(found, name) for name in sun}
    for name, views, told in (
        ("own", scene.views, job.result.target),
        ("held_out", scene.held_out, job.result.held_out),
    ):
        lit = [replace(view, light=replace(view.light, **place)) for view in views]
        job.judged(mug, lit, name, told)
    assert not [name for name in job.report.public if name.startswith("adversarial")]
    assert (job.result.texels_altered, job.result.steps, job.result.evaluations) == (None, 8, 16)


def test_vertices_stay_in_their_budget_are_judged_in_the_target_and_keep_their_texture(
    target: SailenvTarget, mug: Object3D, tmp_path: Path
) -> None:
    job = Finished(target, tmp_path, attack_on="vertices", steps=3, vertex_budget=0.03)
    job.can_be_opened("adversarial.zip", "adversarial.glb")
    moved = load_object(job.read("adversarial.zip"))
    apart = np.linalg.norm(corners(moved) - corners(mug), axis=2)
    assert 0 < apart.max() <= 0.03 * mug.radius
    assert job.result.vertices is not None
    assert job.result.vertices.largest == pytest.approx(apart.max())
    assert {name: moved.files[name] for name in mug.textures} == {name: mug.files[name] for name in mug.textures}
    held = read_object(job.read("adversarial.glb"), name="moved.glb").obj
    np.testing.assert_allclose(np.sort(corners(held).ravel()), np.sort(corners(moved).ravel()), atol=1e-6)
    assert all((held.textures[name] == texture).all() for name, texture in mug.textures.items())
    for name, views, told in (
        ("own", job.scene.views, job.result.target),
        ("held_out", job.scene.held_out, job.result.held_out),
    ):
        job.judged(moved, views, name, told)
