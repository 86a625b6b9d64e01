"""Make the start page's example: a job on a shipped object, and some of its target images.

    python -m scripts.make_gallery --classifier mobilenet_v2.pt2

writes server/trompe_server/pages/gallery.json and static/gallery/*.png beside it. The classes' names are read from
imagenet_classes.json beside the classifier.
"""

import argparse
import json
import tempfile
from pathlib import Path
from typing import Final

from trompe_server.job.texture_attack import open_job
from trompe_server.library import Library
from trompe_server.pages.pictures import Kind, Pictures
from trompe_server.pages.present import command, viewer_record
from trompe_server.renderers import local_renderer
from trompe_server.storage.folders import LocalArtifacts
from trompe_shared.api import ClassifierInfo, JobSpec, Result

PAGES: Final = Path(__file__).parents[1] / "server" / "trompe_server" / "pages"
OBJECT: Final = "teapot"
SHOWN: Final = 8
KINDS: Final[tuple[Kind, ...]] = ("before", "after", "difference")


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--classifier", type=Path, required=True, help="a .pt2 file that knows ImageNet's classes")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        library, artifacts = Library(Path(folder) / "library"), LocalArtifacts(Path(folder) / "job")
        names = json.loads(options.classifier.with_name("imagenet_classes.json").read_bytes())
        with options.classifier.open("rb") as file:
            classifier = library.add_classifier(file, options.classifier.name, classes=names)
        run(JobSpec.of(OBJECT, label=OBJECT, classifier=classifier.id), artifacts, library)
        write(Result.model_validate_json(artifacts.read("result.json")), artifacts, classifier)


def run(spec: JobSpec, artifacts: LocalArtifacts, library: Library) -> None:
    """The job, from beginning to end."""
    with local_renderer() as target:
        job = open_job(spec, library=library, artifacts=artifacts, target=target)
        for phase in job.phases():
            print(phase)
            if job.run(phase, lambda _: None).state is not None:
                break


def write(result: Result, artifacts: LocalArtifacts, classifier: ClassifierInfo) -> None:
    """What the start page shows: held-out views, evenly around the object, whatever became of them."""
    held_out, classes = result.held_out, classifier.classes
    assert held_out is not None
    assert held_out.a_after is not None
    assert classes is not None
    around = sorted(range(len(result.held_out_views)), key=lambda k: result.held_out_views[k].azimuth)
    chosen = around[:: len(around) // SHOWN][:SHOWN]
    pictures, views = Pictures(), []
    for number, view in enumerate(chosen):
        place = PAGES / "static" / "gallery" / str(number)
        place.mkdir(parents=True, exist_ok=True)
        for kind in KINDS:
            (place / f"{kind}.png").write_bytes(pictures.one(artifacts, "held_out", view, kind))
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
