"""Whole jobs on the paper's objects, in this process: what the benches of attacks share."""

import io
import json
import os
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from trompe_server.artifacts import LocalArtifacts
from trompe_server.attack_job import open_pipeline
from trompe_server.library import Library
from trompe_server.target import SailenvTarget
from trompe_shared.api import JobSpec, Result
from trompe_shared.object3d import load_object

__all__ = ["Paper"]


class Paper:
    """The paper's objects and the classifiers beside them, from TROMPE_ASSETS, in a library in ``folder``."""

    def __init__(self, folder: Path, classifiers: Sequence[str]) -> None:
        if "TROMPE_ASSETS" not in os.environ:
            sys.exit("TROMPE_ASSETS must name the folder with the paper's objects and the classifiers.")
        self.assets, self.folder = Path(os.environ["TROMPE_ASSETS"]), folder
        self.library = Library(folder / "library")
        self.objects: dict[str, Any] = json.loads((self.assets / "objects" / "objects.json").read_text())
        names = json.loads((self.assets / "classifiers" / "imagenet_classes.json").read_text())
        for file in classifiers:
            with (self.assets / "classifiers" / file).open("rb") as data:
                self.library.add_classifier(data, file, classes=names)

    def named(self, objects: Sequence[str]) -> list[str]:
        """The objects; ``all`` stands for all ten."""
        return list(self.objects) if list(objects) == ["all"] else list(objects)

    def spec(self, name: str, *, mixed: bool = False, **options: Any) -> JobSpec:
        """The paper's protocol for an object: its distance, elevations and background; with ``mixed`` black, white and
        the photographs."""
        row = self.objects[name]
        stored = self.library.add_object(io.BytesIO(load_object(self.assets / "objects" / name).to_zip()), name)
        protocol = {
            "object": stored.id,
            "label": row["imagenet_class"],
            "distance": row["distance"],
            "elevation": row["elevation_range"],
            "background": [*self._photographs(), "black", "white"] if mixed else row["background"],
        }
        return JobSpec(**(protocol | options))

    def run(self, spec: JobSpec, target: SailenvTarget) -> Result:
        """One job from beginning to end. It pays for its probes, whatever was found out before."""
        self.library.calibrations.delete_all()
        shutil.rmtree(self.folder / "job", ignore_errors=True)
        artifacts = LocalArtifacts(self.folder / "job")
        job = open_pipeline(spec, library=self.library, artifacts=artifacts, target=target)
        for phase in job.phases():
            report = job.run(phase, lambda _: None)
            if report.state is not None:
                break
        return Result.model_validate_json(artifacts.read("result.json"))

    def _photographs(self) -> list[str]:
        files = sorted((self.assets / "backgrounds").glob("*.png"))
        return [self.library.add_background(file.read_bytes(), file.name).id for file in files]
