"""The project's figures in one table: run it before and after a change, and commit both rows.

TROMPE_ASSETS=... python -m bench.scoreboard --row NAME

Three real objects with MobileNetV2 and two shipped ones with `tiny`, attacked as a user would (`trompe attack` against
a running `trompe serve`): by default and on the paper's grid. Finished jobs stay in --work: a stopped run goes on.
"""

import argparse
import json
import os
import re
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from statistics import fmean
from typing import Any, Final
from urllib.request import urlopen

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from bench._common import machine
from trompe_client._embedded import embedded_server
from trompe_experiments.asset_objects import asset_objects
from trompe_experiments.markdown import markdown_table
from trompe_server.classifiers import Classifier, load_classifier

REAL: Final = ("toilet_paper", "lamp_floor", "plunger")
SHIPPED: Final = ("mug", "chair")
VICTIM: Final = "mobilenet_v2.pt2"
LEFT_OUT: Final = "mobilenet_edgetpu_075.pt2"
MODES: Final = ("default", "grid")
PACKAGES: Final = ("shared", "client", "server", "renderer_worker", "experiments", "deploy")
FILE: Final = Path("docs/bench/scoreboard.json")
LATEST: Final = 3

Figures = dict[str, Any]


def main() -> None:
    """Run what is missing, add the row to the JSON file, write the table."""
    options = _options()
    if "TROMPE_ASSETS" not in os.environ:
        sys.exit("TROMPE_ASSETS must name the folder with the real objects and classifiers.")
    assets = Path(os.environ["TROMPE_ASSETS"])
    work = options.work / options.row
    work.mkdir(parents=True, exist_ok=True)
    missing = [name for name in job_names() if not (work / f"{name}.json").exists()]
    if missing:
        os.environ["TROMPE_DATA"] = str(work / "data")
        with embedded_server() as url:
            _wait_until_ready(url)
            for name in missing:
                figures = run_job(name, assets=assets, url=url, out=work / name)
                (work / f"{name}.json").write_text(json.dumps(figures, indent=1))
                print(f"{name}: {figures}", flush=True)
    jobs = {name: json.loads((work / f"{name}.json").read_text()) for name in job_names()}
    rows = json.loads(FILE.read_text()) if FILE.exists() else {}
    rows[options.row] = {"date": time.strftime("%Y-%m-%d"), "machine": machine(), "lines": lines(), "jobs": jobs}
    FILE.write_text(json.dumps(rows, indent=1) + "\n")
    FILE.with_suffix(".md").write_text(page(rows))
    print(page(rows))


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--row", required=True, metavar="NAME", help="name of the row, such as a version or an issue")
    parser.add_argument("--work", type=Path, default=Path("out/scoreboard"), help="folder for finished jobs")
    return parser.parse_args()


def job_names() -> list[str]:
    """``OBJECT-MODE`` of all jobs."""
    return [f"{name}-{mode}" for name in (*REAL, *SHIPPED) for mode in MODES]


def _wait_until_ready(url: str) -> None:
    for _ in range(600):
        with suppress(OSError), urlopen(f"{url}/readyz", timeout=5):
            return
        time.sleep(0.2)
    sys.exit("trompe serve does not become ready")


def run_job(name: str, *, assets: Path, url: str, out: Path) -> Figures:
    """One attack by the command line, and everything the table says of it."""
    obj, _, mode = name.rpartition("-")
    command, victim, left_out = _command(obj, assets)
    if mode == "grid":
        command.append("--grid")
    for pid in _descendants(os.getpid()):
        Path(f"/proc/{pid}/clear_refs").write_text("5")  # forget the peak so far
    before, started = _renders(url), time.perf_counter()
    subprocess.run([*command, "--server", url, "--out", str(out)], check=True, stderr=subprocess.DEVNULL)
    wall = time.perf_counter() - started
    result = json.loads((out / "result.json").read_text())
    return {
        "seconds": round(wall, 1),
        "phases": {phase: round(seconds, 1) for phase, seconds in result["seconds"].items()},
        "renders": round(_renders(url) - before),
        "images_shown": result["evaluations"],
        "peak_memory_mib": max(map(_peak, _descendants(os.getpid()))),
        "a_drop": _rounded(result["target"]["a_drop"]),
        "held_out": _rounded(result["held_out"]["a_drop"]),
        **_judged(out, result["label"], victim, left_out),
    }


def _command(obj: str, assets: Path) -> tuple[list[str], Classifier, Classifier | None]:
    """``trompe attack`` without its destination; the victim and the network left out (none of the shipped object's)."""
    base = [sys.executable, "-m", "trompe_client.cli", "attack"]
    common = ["--epsilon", "0.05", "--seed", "0"]
    if obj in SHIPPED:
        return [*base, obj, "--label", obj, *common], load_classifier("tiny"), None
    row = asset_objects(assets)[obj]
    victim, left_out = (str(assets / "classifiers" / file) for file in (VICTIM, LEFT_OUT))
    views = ["--distance", str(row.distance), "--elevation", *map(str, row.elevation), "--background", row.background]
    command = [*base, str(row.path), "--label", str(row.label), "--classifier", victim, *common, *views]
    return command, load_classifier(victim), load_classifier(left_out)


def _judged(out: Path, label: int, victim: Classifier, left_out: Classifier | None) -> Figures:
    """Drops on the saved held-out images: at half size and back, and on the network left out."""
    before, after = (np.load(out / f"views_{when}.npz")["held_out"] for when in ("before", "after"))
    other = None if left_out is None else _drop(left_out, before, after, label)
    return {"half_size": _drop(victim, half_size(before), half_size(after), label), "left_out": other}


def half_size(images: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """``images`` (views, H, W, 3) resized to half (box filter) and back (bilinear)."""
    _, height, width, _ = images.shape
    small = [Image.fromarray(image).resize((width // 2, height // 2), Image.Resampling.BOX) for image in images]
    return np.stack([np.asarray(image.resize((width, height), Image.Resampling.BILINEAR)) for image in small])


def _drop(classifier: Classifier, before: NDArray[np.uint8], after: NDArray[np.uint8], label: int) -> float | None:
    known, kept = ((classifier.predict(images).argmax(axis=1) == label).mean() for images in (before, after))
    return _rounded(None if known == 0 else (known - kept) / known)


def _rounded(value: float | None) -> float | None:
    return None if value is None else round(float(value), 3)


def _renders(url: str) -> float:
    with urlopen(f"{url}/metrics", timeout=30) as answer:
        text = answer.read().decode()
    return sum(float(value) for value in re.findall(r"^trompe_target_renders_total(?:{.*})? (\S+)", text, re.MULTILINE))


def _descendants(pid: int) -> list[int]:
    """All processes below ``pid``."""
    tasks = Path(f"/proc/{pid}/task").glob("*/children")  # each thread lists its own
    children = [int(child) for task in tasks for child in task.read_text().split()]
    return children + [each for child in children for each in _descendants(child)]


def _peak(pid: int) -> int:
    """Largest resident memory of a process since it was last forgotten, MiB."""
    found = re.search(r"VmHWM:\s+(\d+) kB", Path(f"/proc/{pid}/status").read_text())
    return 0 if found is None else int(found[1]) // 1024


def lines() -> dict[str, int]:
    """Lines of Python that git tracks, by package, and of the tests."""
    listed = subprocess.run(["git", "ls-files", "*.py"], check=True, capture_output=True, text=True).stdout.split()
    counted = dict.fromkeys((*PACKAGES, "tests"), 0)
    for file in filter(os.path.exists, listed):
        top = file.partition("/")[0]
        if top in counted:
            counted[top] += len(Path(file).read_text().splitlines())
    return {"packages": sum(counted[top] for top in PACKAGES), "tests": counted["tests"]}


def page(measured: Mapping[str, Figures]) -> str:
    """The first row and the ``LATEST`` ones as a table in Markdown: means over the objects."""
    names = list(measured)
    rows = {name: measured[name] for name in dict.fromkeys([names[0], *names[-LATEST:]])}
    text = [
        "# Scoreboard",
        "",
        "`make scoreboard ROW=name` (with `TROMPE_ASSETS`) adds a row. Means over three real objects with MobileNetV2",
        f"({', '.join(REAL)}) and two shipped ones with `tiny` ({', '.join(SHIPPED)}); epsilon 0.05, seed 0.",
        "Drops are `A_drop` on held-out views: plain, at half size and back, on a network left out",
        f"(real objects only: `{Path(LEFT_OUT).stem}`). Seconds depend on what else the machine did. All rows and",
        "jobs: [scoreboard.json](scoreboard.json).",
    ]
    for mode in MODES:
        for title, objects in (("real objects", REAL), ("shipped objects", SHIPPED)):
            jobs = {row: [rows[row]["jobs"][f"{name}-{mode}"] for name in objects] for row in rows}
            text += ["", f"## {'Default job' if mode == 'default' else 'Grid'}, {title}", "", _table(jobs)]
    counted = [[row, *(f"{rows[row]['lines'][what]:,}" for what in ("packages", "tests"))] for row in rows]
    text += ["", "## Lines of Python", "", markdown_table(["row", "packages", "tests"], counted, align="lrr")]
    return "\n".join(text) + "\n"


COLUMNS: Final = {
    "plain": "held_out",
    "half size": "half_size",
    "left out": "left_out",
    "seconds": "seconds",
    "renders": "renders",
    "images shown": "images_shown",
    "peak MiB": "peak_memory_mib",
}


def _table(jobs: Mapping[str, Sequence[Figures]]) -> str:
    lines = [[row, *(_cell([job[key] for job in some]) for key in COLUMNS.values())] for row, some in jobs.items()]
    return markdown_table(["row", *COLUMNS], lines, align="l" + "r" * len(COLUMNS))


def _cell(values: Sequence[float | None]) -> str:
    known = [value for value in values if value is not None]
    if not known:
        return ""
    return f"{fmean(known):.2f}" if max(known) <= 1 else f"{fmean(known):,.0f}"


if __name__ == "__main__":
    main()
