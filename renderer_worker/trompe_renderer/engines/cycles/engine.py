"""The Cycles engine. Blender runs in a process of its own, with its own Python: ``bpy`` wants an older NumPy."""

import json
import os
import subprocess
import sys
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import Annotated, Any, Final, Literal

import numpy as np
from click import IntRange
from numpy.typing import NDArray
from PIL import Image

from trompe_renderer.engines.engine import noise_seed
from trompe_renderer.engines.surfaces import (
    ContentCache,
    Surface,
    TextureImage,
    composited,
    ray_range,
    rgba_of,
    scene_table,
    surfaces_of,
    without_backs,
)
from trompe_renderer.world.snapshot import Snapshot
from trompe_shared.engine import EngineInfo
from trompe_shared.errors import RendererError

SCRIPT: Final = Path(__file__).parent / "blender.py"
REMEDY: Final = (
    "Install Blender's module there, pip install bpy; or in an environment of its own, "
    "and name that: --set python=/path/to/bin/python."
)


@dataclass(frozen=True)
class CyclesOptions:
    """``python``: one with ``bpy``. ``view``: Blender's view transform. ``samples``: of a pixel."""

    python: str = field(default=sys.executable, compare=False)
    view: Literal["Standard", "AgX", "Filmic"] = "Standard"
    samples: Annotated[int, IntRange(1, 65536)] = 64


class CyclesEngine:
    """Blender's process ends with this one. A failure of it is left to the caller, not a ``RendererError``."""

    def __init__(self, options: CyclesOptions) -> None:
        self._said = os.memfd_create("blender")  # its standard error, read if it ends
        command = [options.python, str(SCRIPT)]
        try:
            self._blender = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=self._said)
            version = self._call("start", {"view": options.view, "samples": options.samples})
        except (OSError, _BlenderError) as error:
            raise RendererError(f"Blender cannot be started with {options.python} ({error}). {REMEDY}") from error
        self.info = EngineInfo("cycles", version.decode(), deterministic=False)
        self._kept: ContentCache[str] = ContentCache(lambda key: self._call("drop", {"key": key}))

    def render(self, world: Snapshot, *, width: int, height: int) -> NDArray[np.uint8]:
        surfaces = list(surfaces_of(world))
        table = scene_table(world, surfaces, self._kept, add_mesh=self._add_mesh, add_image=self._add_image) | {
            "clip": ray_range(world.camera, [surface.ball for surface in surfaces]),
            "size": [width, height],
            "seed": noise_seed(world),
        }
        data = self._call("draw", {"world": table})
        self._kept.trim()
        with Image.open(BytesIO(data)) as picture:
            rgba = np.asarray(picture.convert("RGBA")) / 255.0
        return composited(rgba[..., :3], rgba[..., 3:], world)

    def _add_mesh(self, surface: Surface) -> tuple[str, int]:
        part = without_backs(surface.part)
        arrays = {"vertices": part.vertices, "normals": part.normals, "uvs": part.uvs, "faces": part.faces}
        self._call("mesh", {"key": surface.key}, **arrays)
        return surface.key, sum(array.nbytes for array in arrays.values())

    def _add_image(self, image: TextureImage) -> tuple[str, int]:
        pixels = rgba_of(image.pixels())
        self._call("image", {"key": image.key, "color": image.use == "albedo"}, pixels=pixels)
        return image.key, 5 * pixels.nbytes

    def _call(self, function: str, values: dict[str, Any], **arrays: NDArray[Any]) -> bytes:
        given = {name: np.ascontiguousarray(array) for name, array in arrays.items()}
        kinds = {name: [array.dtype.str, array.shape] for name, array in given.items()}
        request = {"call": function, "values": values, "arrays": kinds}
        write, read = self._blender.stdin, self._blender.stdout
        assert write is not None
        assert read is not None
        try:
            write.write(json.dumps(request).encode() + b"\n")
            for array in given.values():
                write.write(array.data)
            write.flush()
        except BrokenPipeError:
            pass  # its end is told below
        answer = json.loads(read.readline() or self._end())
        if "error" in answer:
            raise _BlenderError(answer["error"])
        return read.read(answer["size"])

    def _end(self) -> str:
        """An answer that tells why the process has ended."""
        status = self._blender.wait(timeout=5)
        said = os.pread(self._said, 2**20, 0).decode(errors="replace").strip().splitlines()
        return json.dumps({"error": f"its process ended with status {status}. {said[-1] if said else ''}"})


class _BlenderError(Exception):
    """Blender failed or has ended."""
