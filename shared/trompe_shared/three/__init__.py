"""three.js as a file, and lights of the renderer workers in it: for the three engine and for the pages."""

from pathlib import Path
from typing import Final

__all__ = ["FOLDER", "LIGHTS", "THREE"]

FOLDER: Final = Path(__file__).parent
THREE: Final = "three.module.min.js"
"""Name of the module in ``FOLDER``: three's exports and ``GLTFLoader``."""
LIGHTS: Final = "lights.js"
"""Name of the module in ``FOLDER`` with the lights of the renderer workers."""
