"""Speed against accuracy, for what is no option of a job: image size, precision, CPU threads, device, and PyTorch3D in
the place of our surrogate renderer.

python -m bench.speed_accuracy --out docs/experiments/speed_accuracy_more [--objects mug] [--seeds 0] [--only WORDS]

Shipped objects and classifier, with the base, objects and seeds of the experiment `speed_accuracy`, and the same tables
and charts. Resumable: what is in OUT/results.csv is not run again, so that series can come from several runs, such as
PyTorch3D's from the Python that it is installed in. What this machine lacks is left out with a word.
"""

import argparse
import importlib.util
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Final

import torch

from bench.stability import tell
from trompe_client.experiments import load_experiment
from trompe_client.experiments.about import note_how_it_was_made
from trompe_server.experiments.disturbed import at_size, bfloat16_gradients
from trompe_server.experiments.pareto import pareto_markdown
from trompe_server.experiments.suite import Case, Planned, plan_jobs, run_planned
from trompe_server.scene import Scene
from trompe_server.surrogate import Surrogate
from trompe_shared.experiment_table import RowId

NAME: Final = "speed_accuracy_more"
THREADS: Final = 2
"""What all series but that of threads have."""
RENDERER: Final[Mapping[str, Any]] = {"surrogate": "diffuse", "pool": 40, "views_per_step": 20, "steps": 10}
"""Options of the two surrogate renderers: few enough views for PyTorch3D, which takes half a second for each look."""
STANDARD: Final = Case(threads=THREADS)


def by_pytorch3d(scene: Scene) -> Surrogate:
    """PyTorch3D's surrogate; it is imported where it is used, since few have it."""
    from bench._pytorch3d import pytorch3d_surrogate

    return pytorch3d_surrogate(scene)


SERIES: Final[Mapping[str, Mapping[str, Case]]] = {
    "image size": {
        "64": Case(threads=THREADS, classifier=partial(at_size, side=64)),
        "96": Case(threads=THREADS, classifier=partial(at_size, side=96)),
        "128": STANDARD,
        "192": Case(threads=THREADS, classifier=partial(at_size, side=192)),
    },
    "precision": {"float32": STANDARD, "bfloat16": Case(threads=THREADS, classifier=bfloat16_gradients)},
    "CPU threads": {"1": Case(threads=1), "2": STANDARD},
    "device": {"cpu": STANDARD, "cuda": Case(threads=THREADS, device="cuda")},
    "renderer (few views)": {
        "Trompe": Case(threads=THREADS, options=RENDERER),
        "PyTorch3D": Case(threads=THREADS, options=RENDERER, surrogate=by_pytorch3d),
    },
}
"""What is varied, one thing at a time."""


def lacking(case: Case) -> str:
    """What this machine lacks for ``case``, in words; nothing where it has all."""
    if case.device == "cuda" and not torch.cuda.is_available():
        return "there is no CUDA device here"
    if case.surrogate is not None and importlib.util.find_spec("pytorch3d") is None:
        return "PyTorch3D is not installed here"
    return ""


def plan(objects: Sequence[str], seeds: Sequence[int], base: Mapping[str, Any]) -> Iterator[Planned]:
    """All jobs, in the order of the series. PyTorch3D and what it is compared with have the first seed alone."""
    for series, cases in SERIES.items():
        for words, case in cases.items():
            place = RowId(experiment=NAME, key="", series=series, configuration=f"{series} {words}")
            some = seeds[:1] if case.options is RENDERER else seeds
            same = "standard" if case is STANDARD else ""
            yield from plan_jobs(place, case, base, objects=objects, seeds=some, same=same)


def main() -> None:
    """Run what is missing and print the table."""
    experiment, started = load_experiment("speed_accuracy"), time.monotonic()
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, metavar="DIR")
    parser.add_argument(
        "--objects", nargs="+", default=list(experiment.objects), metavar="NAME", help="shipped objects"
    )
    parser.add_argument("--seeds", nargs="+", type=int, default=experiment.seeds, metavar="N")
    parser.add_argument("--only", default="", metavar="WORDS", help="configurations whose name contains this")
    options = parser.parse_args()
    planned = [*plan(options.objects, options.seeds, experiment.base)]
    asked = [each for each in planned if options.only in each.place.configuration]
    for name, reason in {each.place.configuration: lacking(each.case) for each in asked}.items():
        if reason:
            print(f"{name} is left out: {reason}", flush=True)
    rows = run_planned(options.out, planned, wanted=lambda each: each in asked and not lacking(each.case), on_row=tell)
    command = " ".join(["python -m bench.speed_accuracy", *sys.argv[1:]])
    note_how_it_was_made(options.out, command, seconds=time.monotonic() - started)
    print("\n" + pareto_markdown(rows))


if __name__ == "__main__":
    main()
