"""The repainted object as files."""

import re

from trompe_server.formats import repaint_limited, write_glb
from trompe_server.job.protocol import SAILENV
from trompe_shared.api import ADVERSARIAL
from trompe_shared.errors import ObjectError
from trompe_shared.object3d import Object3D


def model_files(painted: Object3D, name: str, original: tuple[bytes, str] | None) -> tuple[dict[str, bytes], list[str]]:
    """The painted object called ``name`` as SAILenv's zip, as GLB and in the format of its upload, by file name
    (``name-adversarial.glb``); and a warning if the last one failed. A GLB of the upload's own replaces ours."""
    files, refused = {".zip": painted.to_zip(), ".glb": write_glb(painted)}, []
    if original is not None:
        data, filename = original
        try:
            same = repaint_limited(data, painted, name=filename)
        except ObjectError as error:
            refused = [f"The object could not be written in the format of its upload ({filename}): {error}"]
        else:
            files |= {SAILENV: files[".zip"]} if same.ending == ".zip" else {}
            files[same.ending] = same.data
    return {f"{_plain(name)}{ADVERSARIAL}{ending}": content for ending, content in files.items()}, refused


def _plain(name: str) -> str:
    """``name`` with the characters of an artifact's name only, and a beginning that it may have."""
    return re.sub(r"[^A-Za-z0-9_.\-]+", "_", name).lstrip(".-")[:100] or "object"
