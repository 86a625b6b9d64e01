"""Make the objects that ship with Trompe: the same command gives the same files.

python scripts/make_objects.py [--out FOLDER] [--only NAME]
"""

import argparse
import json
from pathlib import Path
from typing import Final

from objects.atlas import archive
from objects.furniture import chair, lamp, table
from objects.tableware import bottle, mug, teapot
from objects.things import ball, book

from trompe_shared.object3d import load_object

FOLDER: Final = Path(__file__).parents[1] / "shared" / "trompe_shared" / "shipped"
FRAMING: Final = 2.1
"""Camera distance in radii: the object fills the picture from every side, as ``framing_distance`` has it."""


KINDS: Final = {
    "ball": (ball, (-30, 60)),
    "book": (book, (0, 50)),
    "bottle": (bottle, (-5, 45)),
    "chair": (chair, (0, 50)),
    "lamp": (lamp, (-10, 45)),
    "mug": (mug, (0, 50)),
    "table": (table, (5, 50)),
    "teapot": (teapot, (0, 50)),
}
"""How an object is made, and from which elevations (degrees) it is looked at."""


def main() -> None:
    """Write archives and ``objects.json`` into a folder, by default the one that is part of the package."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=FOLDER, help="folder to write to (default: %(default)s)")
    parser.add_argument("--only", choices=sorted(KINDS), help="make one object's archive and nothing else")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    rows = {}
    for name in [options.only] if options.only else sorted(KINDS):
        make, elevation = KINDS[name]
        data = archive(name, make())
        (options.out / f"{name}.zip").write_bytes(data)
        distance = round(FRAMING * load_object(data).radius, 3)
        rows[name] = {"label": name, "distance": distance, "elevation": elevation}
        print(f"{name}: {len(data) / 1e3:.0f} kB")
    if not options.only:
        (options.out / "objects.json").write_text(json.dumps(rows, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
