"""Make the example of the start page and the README: a job on a shipped object, and some of its target images.

    python -m scripts.make_gallery --classifier mobilenet_v2.pt2

writes server/trompe_server/pages/gallery.json and static/gallery/*.png beside it, docs/images/teapot.png and
docs/bench/teapot.csv. The classes' names are read from imagenet_classes.json beside the classifier.
"""

import argparse
import csv
import io
import json
import tempfile
from pathlib import Path
from typing import Final

from PIL import Image

from trompe_experiments.in_process import run_job
from trompe_experiments.table import ResultRow, RowId
from trompe_server.library import Library
from trompe_server.pages.present import command, viewer_record
from trompe_server.pages.results import Kind, picture_png
from trompe_server.renderers import local_renderer
from trompe_server.storage.folders import LocalArtifacts
from trompe_shared.api import ClassifierInfo, JobSpec, Result

ROOT: Final = Path(__file__).parents[1]
PAGES: Final = ROOT / "server" / "trompe_server" / "pages"
OBJECT: Final = "teapot"
SHOWN: Final = 8
UPPER: Final = 306
"""Height of the title and the first row of a contact sheet, in pixels."""
KINDS: Final[tuple[Kind, ...]] = ("before", "after", "difference")
COLUMNS: Final = (
    *("object", "label", "classifier", "epsilon", "alpha", "seed", "steps_taken", "pool", "held_out_views"),
    *(f"{judge}_a_{what}" for judge in ("surrogate", "target", "held_out") for what in ("before", "after", "drop")),
    *("texels_altered", "mean_texel_change", "ssim", "delta_e", "probe_renders", "evaluations"),
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--classifier", type=Path, required=True, help="a .pt2 file that knows ImageNet's classes")
    options = parser.parse_args()
    names = json.loads(options.classifier.with_name("imagenet_classes.json").read_bytes())
    with tempfile.TemporaryDirectory() as name, local_renderer() as target, options.classifier.open("rb") as file:
        folder = Path(name)
        classifier = Library(folder / "library").add_classifier(file, options.classifier.name, classes=names)
        spec = JobSpec.of(OBJECT, label=OBJECT, classifier=classifier.id)
        result, artifacts = run_job(spec, target, folder).result, LocalArtifacts(folder / "job")
        write_gallery(result, artifacts, classifier)
        write_readme(result, artifacts)


def write_readme(result: Result, artifacts: LocalArtifacts) -> None:
    """The README's picture, the upper part of the contact sheet, and the row with its figures."""
    sheet = Image.open(io.BytesIO(artifacts.read("contact_sheet.png")))
    sheet.crop((0, 0, sheet.width, UPPER)).save(ROOT / "docs" / "images" / f"{OBJECT}.png")
    row = ResultRow.of_result(RowId(experiment="gallery", key=OBJECT), result, state="succeeded").model_dump()
    with (ROOT / "docs" / "bench" / f"{OBJECT}.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS, extrasaction="ignore", lineterminator="\n")
        writer.writeheader()
        writer.writerow({name: round(cell, 4) if isinstance(cell, float) else cell for name, cell in row.items()})


def write_gallery(result: Result, artifacts: LocalArtifacts, classifier: ClassifierInfo) -> None:
    """What the start page shows: held-out views, evenly around the object, whatever became of them."""
    held_out, classes = result.held_out, classifier.classes
    assert held_out is not None
    assert held_out.a_after is not None
    assert classes is not None
    around = sorted(range(len(result.held_out_views)), key=lambda k: result.held_out_views[k].azimuth)
    chosen = around[:: len(around) // SHOWN][:SHOWN]
    views = []
    for number, view in enumerate(chosen):
        place = PAGES / "static" / "gallery" / str(number)
        place.mkdir(parents=True, exist_ok=True)
        for kind in KINDS:
            (place / f"{kind}.png").write_bytes(picture_png(artifacts, "held_out", view, kind))
        address = f"/static/gallery/{number}"
        views.append(viewer_record(result.held_out_views[view], result.labels, classes.__getitem__, address))
    gallery = {
        "object": result.object,
        "classifier": classifier.name,
        "epsilon": result.epsilon,
        "seed": result.seed,
        "command": command(result.spec, object=OBJECT, classifier=f"{classifier.name}.pt2"),
        "views": held_out.views,
        "before": f"{held_out.a_before:.0%}",
        "after": f"{held_out.a_after:.0%}",
        "viewer": [{"name": "held-out", "views": views}],
    }
    (PAGES / "gallery.json").write_text(json.dumps(gallery, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
