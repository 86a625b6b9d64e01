"""Models in the formats people have, into SAILenv's and back: only the albedo changes. See docs/formats.md.

``python -m trompe_server.formats.convert`` does it in a process of its own, which is how uploads are read.
"""

from trompe_server.formats.gltf_write import write_glb
from trompe_server.formats.isolated import import_file, repaint_limited
from trompe_server.formats.registry import FORMATS, Exported, Format, Imported, read_object, repaint_file

__all__ = [
    "FORMATS",
    "Exported",
    "Format",
    "Imported",
    "import_file",
    "read_object",
    "repaint_file",
    "repaint_limited",
    "write_glb",
]
