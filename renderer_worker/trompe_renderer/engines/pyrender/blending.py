"""Blended surfaces: drawn last, back to front, triangle by triangle. For the OpenGL thread only.

Each fragment is composited over the image so far by its alpha. It writes no depth, so what lies behind it stays
visible in any order of drawing, and casts no shadow: light goes through.
"""

from collections.abc import Iterator, Sequence
from itertools import product
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from trompe_renderer.engines.pyrender.platform import GL, pyrender
from trompe_renderer.world.snapshot import Matrix

PIECES: Final = 64
"""Draws that surfaces nested in each other are split into."""


class BlendedPrimitive(pyrender.Primitive):  # type: ignore[misc]
    """A primitive whose triangles are drawn in the order of the picture."""

    is_transparent = True

    def __init__(self, **content: Any) -> None:
        super().__init__(**content)
        self._faces = np.asarray(content["indices"], np.uint32)
        self.centres = self.positions[self._faces].mean(axis=1)

    def show(self, order: "NDArray[np.int64] | slice") -> None:
        """Draw the triangles with these numbers from now on, in this order."""
        self._indices = self._faces[order]
        self._bind()
        GL.glBindBuffer(GL.GL_ELEMENT_ARRAY_BUFFER, self._buffers[-1])
        GL.glBufferData(GL.GL_ELEMENT_ARRAY_BUFFER, self._indices.nbytes, self._indices, GL.GL_STREAM_DRAW)
        self._unbind()


def back_to_front(
    surfaces: Sequence[tuple[BlendedPrimitive, Matrix]], view: Matrix
) -> Iterator[tuple[int, NDArray[np.int64]]]:
    """(Number of a surface, numbers of its triangles) in the order to draw: pieces of depth, the farthest first.

    surfaces: with their poses, object to world. view (4, 4): world to camera.
    """
    heights = [primitive.centres @ (view @ pose)[2, :3] + (view @ pose)[2, 3] for primitive, pose in surfaces]
    orders = [height.argsort(kind="stable") for height in heights]  # z of the camera: the farthest is the lowest
    count = 1 if len(surfaces) == 1 else max(1, PIECES // len(surfaces))
    far, near = min(height.min() for height in heights), max(height.max() for height in heights)
    cuts = np.linspace(far, near, count + 1)[1:-1]
    pieces = [
        np.split(order, np.searchsorted(height[order], cuts)) for order, height in zip(orders, heights, strict=True)
    ]
    farthest_first = sorted(range(len(surfaces)), key=lambda number: heights[number].mean())
    for piece, number in product(range(count), farthest_first):
        if len(pieces[number][piece]):
            yield number, pieces[number][piece]
