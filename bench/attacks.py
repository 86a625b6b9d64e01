"""Whole attacks on the paper's objects: surrogate and target before and after, by colour model and saliency threshold.

TROMPE_ASSETS=... python -m bench.attacks --csv docs/bench/attacks.csv
"""

import argparse
import csv
import json
import os
import sys
import tempfile
import time
from pathlib import Path

from bench._common import running_renderer
from trompe_server.artifacts import LocalArtifacts
from trompe_server.attack_job import open_pipeline
from trompe_server.library import Library
from trompe_server.target import SailenvTarget
from trompe_shared.api import JobSpec, Result
from trompe_shared.object3d import load_object

OBJECTS = ("toilet_paper", "lamp_floor", "remote_controller", "plunger")
SETTINGS: tuple[tuple[str, float | None], ...] = (
    ("auto", None),
    ("curve", None),
    ("diffuse", None),
    ("auto", 0.05),
    ("auto", 0.2),
)
COLUMNS = (
    *("object", "surrogate", "tau", "epsilon", "steps", "probes"),
    *("surrogate before", "surrogate after", "target before", "target after", "A_drop"),
    *("held-out before", "held-out after", "N%", "seconds"),
)


def main() -> None:
    """Run every object under every setting and print a row for each."""
    options = _options()
    assets = Path(os.environ["TROMPE_ASSETS"])
    rows = []
    print("| " + " | ".join(COLUMNS) + " |\n|" + "---|" * len(COLUMNS))
    with tempfile.TemporaryDirectory() as folder, running_renderer() as target:
        library = _library(Path(folder), assets, options.classifier)
        for name in options.objects:
            for number, (surrogate, tau) in enumerate(SETTINGS[:1] if options.pool else SETTINGS):
                spec = _spec(name, library, assets, options).model_copy(update={"surrogate": surrogate, "tau": tau})
                started = time.perf_counter()
                result = _run(spec, library, target, Path(folder) / f"{name}-{number}")
                rows.append(_row(name, result, time.perf_counter() - started))
                print("| " + " | ".join(rows[-1]) + " |", flush=True)
    if options.csv:
        with options.csv.open("w", newline="") as file:
            csv.writer(file, lineterminator="\n").writerows([COLUMNS, *rows])


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--objects", nargs="+", default=OBJECTS)
    parser.add_argument("--classifier", default="mobilenet_v2")
    parser.add_argument("--epsilon", type=float, default=0.05)
    parser.add_argument("--steps", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--pool", type=int, default=0, help="attack so many random views, not the paper's grid")
    parser.add_argument("--held-out", type=int, default=60)
    parser.add_argument("--csv", type=Path)
    if "TROMPE_ASSETS" not in os.environ:
        sys.exit("TROMPE_ASSETS must name the folder with the paper's objects and the classifiers.")
    return parser.parse_args()


def _library(folder: Path, assets: Path, classifier: str) -> Library:
    library = Library(folder / "library")
    names = json.loads((assets / "classifiers" / "imagenet_classes.json").read_text())
    with (assets / "classifiers" / f"{classifier}.pt2").open("rb") as file:
        library.add_classifier(file, f"{classifier}.pt2", classes=names)
    return library


def _spec(name: str, library: Library, assets: Path, options: argparse.Namespace) -> JobSpec:
    """The paper's protocol for an object: its distance, elevations and background, 60 views."""
    paper = json.loads((assets / "objects" / "objects.json").read_text())[name]
    stored = library.add_object(load_object(assets / "objects" / name).to_zip(), name)
    return JobSpec(
        object=stored.id,
        label=paper["imagenet_class"],
        classifier=options.classifier,
        epsilon=options.epsilon,
        alpha=min(0.01, options.epsilon / 5),
        steps=options.steps,
        seed=options.seed,
        distance=paper["distance"],
        elevation=paper["elevation_range"],
        background=paper["background"],
        pool=options.pool,
        held_out=options.held_out,
    )


def _run(spec: JobSpec, library: Library, target: SailenvTarget, folder: Path) -> Result:
    artifacts = LocalArtifacts(folder)
    job = open_pipeline(spec, library=library, artifacts=artifacts, target=target)
    for phase in job.phases():
        report = job.run(phase, lambda _: None)
        if report.state is not None:
            break
    return Result.model_validate_json(artifacts.read("result.json"))


def _row(name: str, result: Result, seconds: float) -> list[str]:
    views = (result.surrogate, result.target, result.held_out)
    pairs = [f"{value:.2f}" if value is not None else "n.a." for v in views for value in _pair(v)]
    drop = "n.a." if result.target.a_drop is None else f"{result.target.a_drop:.2f}"
    altered = "n.a." if result.texels_altered is None else f"{result.texels_altered:.3f}"
    head = [name, result.surrogate_model, str(result.tau or "-"), f"{result.epsilon:g}", str(result.steps)]
    return [*head, str(result.probe_renders), *pairs[:4], drop, *pairs[4:], altered, f"{seconds:.0f}"]


def _pair(accuracy: object) -> tuple[float | None, float | None]:
    return getattr(accuracy, "a_before", None), getattr(accuracy, "a_after", None)


if __name__ == "__main__":
    main()
