"""Read or repaint one model file in a separate process, started by ``isolated``.

``convert read FILE NAME MAX_TEXTURE ARCHIVE`` writes the object as SAILenv's zip (MAX_TEXTURE 0: no limit).
``convert repaint FILE NAME ARCHIVE OUT`` writes the model file with the paint of ARCHIVE. Both print one line of JSON.
"""

import json
import sys
from collections.abc import Sequence
from pathlib import Path

from trompe_server.formats.registry import facts_of, read_object, repaint_file
from trompe_shared.errors import TrompeError
from trompe_shared.object3d import load_object


def _read(file: str, name: str, max_texture: str, archive: str) -> dict[str, object]:
    imported = read_object(Path(file).read_bytes(), name=name, max_texture=int(max_texture) or None)
    Path(archive).write_bytes(imported.obj.to_zip())
    return {"format": imported.format, **facts_of(imported.obj)}


def _repaint(file: str, name: str, archive: str, out: str) -> dict[str, object]:
    exported = repaint_file(Path(file).read_bytes(), load_object(Path(archive).read_bytes()), name=name)
    Path(out).write_bytes(exported.data)
    return {"ending": exported.ending}


def main(arguments: Sequence[str]) -> int:
    """Run the command and print its answer; return the exit code."""
    what, *rest = arguments
    try:
        answer = _read(*rest) if what == "read" else _repaint(*rest)
    except TrompeError as error:
        answer = {"error": str(error)}
    sys.stdout.write(json.dumps(answer) + "\n")
    return int("error" in answer)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
