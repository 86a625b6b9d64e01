"""Memory for the geometry of a million faces and a 4096 x 4096 texture is bounded."""

import subprocess
import sys
import textwrap

import pytest

PREPARE = """
    import resource
    import numpy as np
    import torch
    from trompe_server.surrogate import SamplingModel, prepare_geometry
    from trompe_shared.geometry import Camera, View
    from trompe_shared.object3d import Material, Object3D, Part, encode_png

    def ball(rows, columns):
        v, u = np.meshgrid(np.linspace(0, 1, rows + 1), np.linspace(0, 1, columns + 1), indexing="ij")
        tilt, turn = (v - 0.5) * np.pi, u * 2 * np.pi
        normals = np.stack([np.cos(tilt) * np.sin(turn), np.sin(tilt), np.cos(tilt) * np.cos(turn)], -1)
        normals, uvs = normals.reshape(-1, 3).astype(np.float32), np.stack([u, v], -1).reshape(-1, 2).astype(np.float32)
        first = (np.arange(rows)[:, None] * (columns + 1) + np.arange(columns)).ravel()
        corners = [first, first + 1, first + columns + 2, first, first + columns + 2, first + columns + 1]
        return Part("m", 0.1 * normals, normals, uvs, np.stack(corners, 1).reshape(-1, 3).astype(np.int32))

    def peak():
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024

    texture = np.zeros(({side}, {side}, 3), np.uint8)
    obj = Object3D("ball", {{"a.png": encode_png(texture)}}, (ball({rows}, {rows}),), {{"m": Material("m", "a.png")}},
                   {{"a.png": texture}})
    views = [View(Camera(0.3, 90.0 * k, 20)) for k in range(4)]
    torch.zeros(1).sum()
    before = peak()
    geometry = prepare_geometry(obj, views, size=(224, 224), sampling=SamplingModel())
    print(peak() - before, len(geometry.batches[0].pixel), geometry.nbytes / 2**20)
"""


def prepared(*, rows: int, side: int) -> tuple[float, int, float]:
    """Peak MiB of preparing four views, object pixels, and MiB of the operators.

    The object is a ball of 2 rows**2 faces with a texture of side x side texels.
    """
    command = [sys.executable, "-c", textwrap.dedent(PREPARE.format(rows=rows, side=side))]
    numbers = subprocess.run(command, check=True, capture_output=True, text=True, timeout=240).stdout.split()
    return float(numbers[0]), int(numbers[1]), float(numbers[2])


def test_a_million_faces_and_4096_x_4096_texels_take_less_than_640_mib() -> None:
    taken, pixels, operators = prepared(rows=707, side=4096)
    assert pixels > 4 * 10_000
    assert operators < 16
    assert taken < 640  # 110 for the triangles and 105 for two tables of texels


@pytest.mark.thorough
def test_a_finer_mesh_or_texture_needs_no_larger_operators() -> None:
    (_, few, small), (_, many, large) = prepared(rows=50, side=512), prepared(rows=300, side=2048)
    assert abs(few - many) < 0.02 * few
    assert large < 1.5 * small
