"""Model files in and out: conversion to SAILenv's format, and repainting of the original, where only albedo changes.

The server reads uploads in a separate process, ``python -m trompe_server.formats.convert``.
"""

from trompe_server.formats.gltf_write import write_glb
from trompe_server.formats.isolated import import_file, repaint_limited
from trompe_server.formats.registry import facts_of, read_object, repaint_file

__all__ = ["facts_of", "import_file", "read_object", "repaint_file", "repaint_limited", "write_glb"]
