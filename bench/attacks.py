"""Whole attacks on the paper's objects: surrogate and target before and after, by epsilon, colour model, tau and seed.

TROMPE_ASSETS=... python -m bench.attacks --csv docs/bench/attacks.csv
                  python -m bench.attacks --plain --objects all --epsilon 0.05 0.02 --csv docs/bench/attacks_grid.csv
                  python -m bench.attacks --plain --objects all --pool 240 --steps 30 --held-out 200 --mixed
"""

import argparse
import csv
import itertools
import json
import os
import shutil
import sys
import tempfile
import time
from pathlib import Path

from bench._common import running_renderer
from trompe_server.artifacts import LocalArtifacts
from trompe_server.attack_job import open_pipeline
from trompe_server.library import Library
from trompe_server.target import SailenvTarget
from trompe_shared.api import Accuracy, JobSpec, Result
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
    *("object", "surrogate", "tau", "epsilon", "steps", "seed", "probes"),
    *("surrogate before", "surrogate after", "target before", "target after", "A_drop"),
    *("held-out before", "held-out after", "held-out A_drop", "N%", "SSIM", "CIEDE2000"),
    *("evaluations", "prepare s", "calibrate s", "attack s", "judge s", "seconds"),
)


def main() -> None:
    """Run every object under every setting and print a row for each."""
    options = _options()
    assets = Path(os.environ["TROMPE_ASSETS"])
    rows = []
    print("| " + " | ".join(COLUMNS) + " |\n|" + "---|" * len(COLUMNS))
    with tempfile.TemporaryDirectory() as folder, running_renderer() as target:
        library = _library(Path(folder), assets, options.classifier)
        names = json.loads((assets / "objects" / "objects.json").read_text())
        runs = itertools.product(
            names if options.objects == ["all"] else options.objects,
            options.epsilon,
            SETTINGS[:1] if options.plain else SETTINGS,
            options.seeds,
        )
        for number, (name, epsilon, (surrogate, tau), seed) in enumerate(runs):
            changes = {"surrogate": surrogate, "tau": tau, "seed": seed}
            spec = _spec(name, library, assets, options, epsilon).model_copy(update=changes)
            shutil.rmtree(library.calibrations.folder, ignore_errors=True)  # every run pays for its probes
            started = time.perf_counter()
            result = _run(spec, library, target, Path(folder) / str(number))
            rows.append(_row(name, result, time.perf_counter() - started))
            print("| " + " | ".join(rows[-1]) + " |", flush=True)
    if options.csv:
        with options.csv.open("w", newline="") as file:
            csv.writer(file, lineterminator="\n").writerows([COLUMNS, *rows])


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--objects", nargs="+", default=OBJECTS, help="names, or all")
    parser.add_argument("--plain", action="store_true", help="only the automatic surrogate without saliency")
    parser.add_argument("--classifier", default="mobilenet_v2")
    parser.add_argument("--epsilon", type=float, nargs="+", default=[0.05])
    parser.add_argument("--steps", type=int, default=20)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--pool", type=int, default=0, help="attack so many random views, not the paper's grid")
    parser.add_argument("--held-out", type=int, default=60)
    parser.add_argument("--mixed", action="store_true", help="black, white and the photographs as backgrounds")
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


def _spec(name: str, library: Library, assets: Path, options: argparse.Namespace, epsilon: float) -> JobSpec:
    """The paper's protocol for an object: its distance, elevations and background."""
    paper = json.loads((assets / "objects" / "objects.json").read_text())[name]
    stored = library.add_object(load_object(assets / "objects" / name).to_zip(), name)
    return JobSpec(
        object=stored.id,
        label=paper["imagenet_class"],
        classifier=options.classifier,
        epsilon=epsilon,
        steps=options.steps,
        distance=paper["distance"],
        elevation=paper["elevation_range"],
        background=[*_photographs(library, assets), "black", "white"] if options.mixed else paper["background"],
        pool=options.pool,
        held_out=options.held_out,
    )


def _photographs(library: Library, assets: Path) -> list[str]:
    return [
        library.add_background(file.read_bytes(), file.name).id
        for file in sorted((assets / "backgrounds").glob("*.png"))
    ]


def _run(spec: JobSpec, library: Library, target: SailenvTarget, folder: Path) -> Result:
    artifacts = LocalArtifacts(folder)
    job = open_pipeline(spec, library=library, artifacts=artifacts, target=target)
    for phase in job.phases():
        report = job.run(phase, lambda _: None)
        if report.state is not None:
            break
    return Result.model_validate_json(artifacts.read("result.json"))


def _row(name: str, result: Result, seconds: float) -> list[str]:
    own, held_out = result.target, result.held_out
    pairs = [_number(value) for views in (result.surrogate, own, held_out) for value in _pair(views)]
    head = [name, result.surrogate_model, str(result.tau or "-"), f"{result.epsilon:g}", str(result.steps)]
    phases = [f"{result.seconds.get(phase, 0.0):.1f}" for phase in ("prepare", "calibrate", "attack", "judge")]
    return [
        *head,
        *(str(result.seed), str(result.probe_renders)),
        *(*pairs[:4], _number(own.a_drop)),
        *(*pairs[4:], _number(held_out.a_drop if held_out else None)),
        *(_number(value, 3) for value in (result.texels_altered, result.ssim, result.delta_e)),
        *(str(result.evaluations or 0), *phases, f"{seconds:.1f}"),
    ]


def _pair(accuracy: Accuracy | None) -> tuple[float | None, float | None]:
    return (None, None) if accuracy is None else (accuracy.a_before, accuracy.a_after)


def _number(value: float | None, digits: int = 2) -> str:
    return "n.a." if value is None else f"{value:.{digits}f}"


if __name__ == "__main__":
    main()
