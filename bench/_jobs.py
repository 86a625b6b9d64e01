"""Whole jobs on the paper's objects, in this process, and tables that grow by them: what benches of attacks share."""

import csv
import io
import json
import os
import shutil
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Generic, TypeVar

from pydantic import BaseModel

from trompe_server.artifacts import LocalArtifacts
from trompe_server.attack_job import open_pipeline
from trompe_server.library import Library
from trompe_server.target import SailenvTarget
from trompe_shared.api import JobSpec, Result
from trompe_shared.asset_objects import asset_objects
from trompe_shared.object3d import load_object

__all__ = ["Paper", "Rows"]

Row = TypeVar("Row", bound=BaseModel)


class Rows(Generic[Row]):
    """Rows of one kind, and the CSV ``file`` (if any) that each is added to at once: a bench that was stopped goes on.

    Empty cells are ``None``.
    """

    def __init__(self, kind: type[Row], file: Path | None) -> None:
        self.kind, self.file, self.rows = kind, file, list[Row]()
        if file is not None and file.exists():
            with file.open(newline="", encoding="utf-8") as lines:
                for line in csv.DictReader(lines):
                    self.rows.append(kind.model_validate({name: value or None for name, value in line.items()}))

    def find(self, key: Mapping[str, Any]) -> list[Row]:
        """The rows that have all values of ``key``."""
        return [row for row in self.rows if all(getattr(row, name) == value for name, value in key.items())]

    def get(self, key: Mapping[str, Any], make: Callable[[], Row]) -> Row:
        """The row that has all values of ``key``; where there is none, it is made and added."""
        found = self.find(key)
        return found[0] if found else self.add(make())

    def add(self, row: Row) -> Row:
        """Keep ``row``."""
        self.rows.append(row)
        if self.file is not None:
            new = not self.file.exists()
            with self.file.open("a", newline="", encoding="utf-8") as file:
                writer = csv.DictWriter(file, list(self.kind.model_fields), lineterminator="\n")
                if new:
                    writer.writeheader()
                writer.writerow(row.model_dump())
        return row


class Paper:
    """The paper's objects and the classifiers beside them, from TROMPE_ASSETS, in a library in ``folder``."""

    def __init__(self, folder: Path, classifiers: Sequence[str]) -> None:
        if "TROMPE_ASSETS" not in os.environ:
            sys.exit("TROMPE_ASSETS must name the folder with the paper's objects and the classifiers.")
        self.assets, self.folder = Path(os.environ["TROMPE_ASSETS"]), folder
        self.library = Library(folder / "library")
        self.objects = asset_objects(self.assets)
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
        stored = self.library.add_object(io.BytesIO(load_object(row.path).to_zip()), name)
        protocol: dict[str, Any] = {
            "object": stored.id,
            "label": row.label,
            "distance": row.distance,
            "elevation": row.elevation,
            "background": [*self._photographs(), "black", "white"] if mixed else row.background,
        }
        return JobSpec(**(protocol | options))

    def run(self, spec: JobSpec, target: SailenvTarget, *, known: bool = False) -> Result:
        """One job from beginning to end. It pays for its probes, unless those of earlier ones count as ``known``."""
        if not known:
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
