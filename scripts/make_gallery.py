"""Make the start page's example: the demo's job on a shipped object, and some of its target images.

    python -m scripts.make_gallery

writes server/trompe_server/pages/gallery.json and static/gallery/*.png beside it.
"""

import json
import tempfile
from pathlib import Path
from typing import Final

from trompe_server.job.texture_attack import open_job
from trompe_server.library import Library
from trompe_server.pages.pictures import Kind, Pictures
from trompe_server.pages.present import viewer_record
from trompe_server.renderers import local_renderer
from trompe_server.storage.folders import LocalArtifacts
from trompe_shared.api import JobSpec, Result
from trompe_shared.shipped import shipped_objects

PAGES: Final = Path(__file__).parents[1] / "server" / "trompe_server" / "pages"
SPEC: Final = JobSpec.of("mug", label="mug", classifier="tiny", steps=100)
"""What `trompe demo` asks for."""
SHOWN: Final = 8
KINDS: Final[tuple[Kind, ...]] = ("before", "after", "difference")
CLASSES: Final = sorted({shipped.label for shipped in shipped_objects().values()})
"""Of the shipped classifier, in the order of its logits."""


def main() -> None:
    """The command."""
    with tempfile.TemporaryDirectory() as folder:
        artifacts = LocalArtifacts(Path(folder) / "job")
        run(artifacts, Library(Path(folder) / "library"))
        write(Result.model_validate_json(artifacts.read("result.json")), artifacts)


def run(artifacts: LocalArtifacts, library: Library) -> None:
    """The job, from beginning to end."""
    with local_renderer() as target:
        job = open_job(SPEC, library=library, artifacts=artifacts, target=target)
        for phase in job.phases():
            print(phase)
            job.run(phase, lambda _: None)


def write(result: Result, artifacts: LocalArtifacts) -> None:
    """What the start page shows: held-out views, evenly around the object, whatever became of them."""
    held_out = result.held_out
    assert held_out is not None
    assert held_out.a_after is not None
    around = sorted(range(len(result.held_out_views)), key=lambda k: result.held_out_views[k].azimuth)
    chosen = around[:: len(around) // SHOWN][:SHOWN]
    pictures, views = Pictures(), []
    for number, view in enumerate(chosen):
        place = PAGES / "static" / "gallery" / str(number)
        place.mkdir(parents=True, exist_ok=True)
        for kind in KINDS:
            (place / f"{kind}.png").write_bytes(pictures.one(artifacts, "held_out", view, kind))
        address = f"/static/gallery/{number}"
        views.append(viewer_record(result.held_out_views[view], result.labels, CLASSES.__getitem__, address))
    gallery = {
        "object": result.object,
        "epsilon": f"{result.epsilon:.0%}",
        "views": held_out.views,
        "before": f"{held_out.a_before:.0%}",
        "after": f"{held_out.a_after:.0%}",
        "viewer": [{"name": "held-out", "views": views}],
    }
    (PAGES / "gallery.json").write_text(json.dumps(gallery, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
