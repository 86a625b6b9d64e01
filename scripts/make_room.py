"""Make the furnished room that comes with the renderer worker: the same command gives the same files.

python scripts/make_room.py [--out FOLDER]

The room is 4 x 3.6 x 2.5 m around the origin, y up, the floor at 0; its surfaces face inwards, so that light from
outside comes in and none of them stands between it and the furniture. A window in the wall at -z shows the sky.
"""

import argparse
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from objects.brushes import clouds, mix, rgb, smooth, wood
from objects.mesh import Array, Texels

from trompe_renderer.check.probes import FACES
from trompe_shared.local_files import pack_zip
from trompe_shared.object3d import encode_png, load_object
from trompe_shared.shipped import shipped_objects

FOLDER: Final = Path(__file__).parents[1] / "renderer_worker" / "trompe_renderer" / "world" / "room_01"
LOW: Final = np.array([-2.0, 0.0, -1.8])
HIGH: Final = np.array([2.0, 2.5, 1.8])
WINDOW: Final = ((-0.6, 0.6), (0.95, 2.05))
"""The opening in the wall at -z: range of x, range of y, metres."""
RUG_TOP: Final = 0.013
TABLE_TOP: Final = RUG_TOP + 0.74

Image = NDArray[np.uint8]


@dataclass
class Mesh:
    """Rectangles by material, and what each material is painted with; a texture repeats every ``tile`` metres."""

    textures: Mapping[str, Image]
    tiles: Mapping[str, float] = field(default_factory=dict)
    smoothness: Mapping[str, int] = field(default_factory=dict)
    faces: dict[str, list[tuple[Array, Array, Array]]] = field(default_factory=dict)

    def rectangle(self, material: str, center: Array, across: Array, up: Array) -> None:
        """Seen from where ``across`` (half the width) is to the right of ``up`` (half the height)."""
        signs = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])
        corners = center + signs @ np.stack([across, up])
        tile = self.tiles.get(material)
        sizes = 2 * np.array([np.linalg.norm(across), np.linalg.norm(up)])
        uvs = (signs + 1) / 2 * (sizes / tile if tile else 1.0)
        normal = np.cross(across, up)
        self.faces.setdefault(material, []).append((corners, uvs, normal / np.linalg.norm(normal)))

    def box(
        self, material: str, low: Sequence[float], high: Sequence[float], sides: Sequence[str] = tuple(FACES)
    ) -> None:
        """A box between two corners, closed or with only some of its sides."""
        center, half = (np.array(low) + high) / 2, (np.array(high) - low) / 2
        for normal, up, _ in (FACES[side] for side in sides):
            across = np.cross(up, normal)
            self.rectangle(material, center + half * normal, half * across, half * np.array(up))

    def archive(self, name: str) -> bytes:
        """The zip of the object in SAILenv's format."""
        lines, count = [f"o {name}"], 0
        for material, faces in self.faces.items():
            lines.append(f"usemtl {material}")
            for corners, uvs, normal in faces:
                lines += ["v {:.4f} {:.4f} {:.4f}".format(*corner) for corner in corners]
                lines += ["vt {:.4f} {:.4f}".format(*uv) for uv in uvs]
                lines.append("vn {:.0f} {:.0f} {:.0f}".format(*normal))
                number = count // 4 + 1
                lines.append("f " + " ".join(f"{count + k}/{count + k}/{number}" for k in (1, 2, 3, 4)))
                count += 4
        files = {f"{name}.obj": "\n".join(lines).encode() + b"\n"}
        table: dict[str, dict[str, str]] = {}
        for material in self.faces:
            table[material] = {"albedo": f"{material}.png"}
            files[f"{material}.png"] = encode_png(self.textures[material])
            if material in self.smoothness:
                table[material]["metallic"] = f"{material}_smooth.png"
                plain = np.array([0, 0, 0, self.smoothness[material]], np.uint8)
                files[f"{material}_smooth.png"] = encode_png(np.broadcast_to(plain, (4, 4, 4)).copy())
        return pack_zip({f"{name}_mat_def.json": json.dumps(table).encode()} | files)


# --- paint ---


def plain(code: str) -> Image:
    """One colour."""
    return np.broadcast_to(np.rint(255 * rgb(code)).astype(np.uint8), (4, 4, 3)).copy()


def as_bytes(colour: Array) -> Image:
    """[0, 1] to uint8 in steps of 4 levels, which halves the files."""
    return (np.clip(np.round(colour * 63), 0, 63) * 4).astype(np.uint8)


def grained(
    width: float, height: float, texels: int, *, seed: int, light: str = "c89f6d", dark: str = "8a5f36"
) -> Array:
    """Wood with the grain along its width: (h, texels, 3), for a board of that size in metres."""
    x, y = np.meshgrid(np.linspace(0, width, texels), np.linspace(0, height, round(texels * height / width)))
    position = np.stack([x + seed, y + 0.37 * seed, np.full_like(x, 0.05)], axis=-1)
    board = Texels(x, y, (width, height), position, width / texels)
    return wood(light=light, dark=dark, along=0, ring=0.02, seed=seed)(board).colour


def planks() -> Image:
    """1.2 x 1.2 m of floor: eight planks, the ends of every other one half a length further."""
    rows = []
    for number in range(8):
        plank = grained(1.2, 0.15, 256, seed=number + 1) * (0.92 + 0.02 * (number * 5 % 8))
        plank[:1], plank[:, :1] = plank[:1] * 0.45, plank[:, :1] * 0.45
        rows.append(np.roll(plank, 128 * (number % 2) + 37 * number, axis=1))
    return as_bytes(np.concatenate(rows))


def plaster(code: str, seed: int) -> Image:
    """A wall's paint, barely uneven; repeats without a seam."""
    rough = np.random.default_rng(seed).normal(0, 1, (64, 64))
    uneven = np.mean([np.roll(rough, (i, j), (0, 1)) for i in (-1, 0, 1) for j in (-1, 0, 1)], axis=0)
    return as_bytes(rgb(code) * (1 + 0.03 * uneven[..., None]))


def rug() -> Image:
    """1.8 x 1.2 m of woven diamonds with a border."""
    y, x = np.mgrid[0:128, 0:192] + 0.5
    edge = np.minimum.reduce([x, 192 - x, y, 128 - y])
    diamonds = (np.abs((x - 96) % 24 - 12) + np.abs((y - 64) % 24 - 12)) / 12
    colour = mix(rgb("7c2f2a"), np.broadcast_to(rgb("d9b382"), (128, 192, 3)), smooth(0.75, 0.85, diamonds))
    colour = mix(colour, np.broadcast_to(rgb("23395b"), colour.shape), smooth(0.35, 0.25, diamonds))
    colour = mix(np.broadcast_to(rgb("23395b"), colour.shape), colour, smooth(10, 11, edge))
    return as_bytes(colour * (0.9 + 0.1 * ((x + y) % 2))[..., None])


def landscape() -> Image:
    """Hills under an evening sky."""
    y, x = np.mgrid[0:96, 0:144] / 96
    colour = mix(rgb("5b7fb0"), np.broadcast_to(rgb("f2b67c"), (96, 144, 3)), smooth(0.0, 0.7, y))
    for number, code in enumerate(("6e7f93", "4d6a5c", "2f4a35")):
        line = clouds(np.stack([x * (3 + number), np.full_like(x, number), x * 0], -1), 40 + number)
        colour = mix(
            colour,
            np.broadcast_to(rgb(code), colour.shape),
            smooth(0, 0.01, y - 0.35 - 0.18 * number - 0.3 * (line - 0.5)),
        )
    return as_bytes(colour)


def panelled(code: str, columns: int, rows: int) -> Image:
    """A door's leaf: sunk panels with light from above left."""
    y, x = np.mgrid[0 : 64 * rows, 0 : 64 * columns] % 64 + 0.5
    edge = np.minimum.reduce([x, 64 - x, y, 64 - y])
    sunk = smooth(9, 11, edge)
    lit = np.where(x + y < 64, -1.0, 1.0) * sunk * (1 - smooth(13, 15, edge))
    return as_bytes(rgb(code) * (1 - 0.06 * sunk + 0.2 * lit)[..., None])


# --- the parts ---


def floor() -> Mesh:
    mesh = Mesh({"planks": planks()}, {"planks": 1.2}, {"planks": 120})
    mesh.box("planks", (LOW[0], -0.1, LOW[2]), (HIGH[0], 0.0, HIGH[2]), ["top"])
    return mesh


def ceiling() -> Mesh:
    mesh = Mesh({"white": plaster("e8e6df", 5)}, {"white": 1.0})
    mesh.box("white", (LOW[0], HIGH[1], LOW[2]), (HIGH[0], HIGH[1] + 0.1, HIGH[2]), ["bottom"])
    return mesh


def walls() -> Mesh:
    """Four walls, one around the window, and a skirting board."""
    mesh = Mesh({"paint": plaster("c9cfc2", 3), "board": plain("efece4")}, {"paint": 1.0})
    (left, right), (sill, head) = WINDOW
    mesh.box("paint", (LOW[0] - 0.1, 0, LOW[2]), (LOW[0], HIGH[1], HIGH[2]), ["right"])
    mesh.box("paint", (HIGH[0], 0, LOW[2]), (HIGH[0] + 0.1, HIGH[1], HIGH[2]), ["left"])
    mesh.box("paint", (LOW[0], 0, HIGH[2]), (HIGH[0], HIGH[1], HIGH[2] + 0.1), ["back"])
    for low, high in (
        ((LOW[0], 0.0), (left, HIGH[1])),
        ((right, 0.0), (HIGH[0], HIGH[1])),
        ((left, 0.0), (right, sill)),
        ((left, head), (right, HIGH[1])),
    ):
        mesh.box("paint", (*low, LOW[2] - 0.1), (*high, LOW[2]), ["front"])
    thick, tall = 0.015, 0.09
    mesh.box("board", (LOW[0], 0, LOW[2]), (LOW[0] + thick, tall, HIGH[2]), ["right", "top"])
    mesh.box("board", (HIGH[0] - thick, 0, LOW[2]), (HIGH[0], tall, HIGH[2]), ["left", "top"])
    mesh.box("board", (LOW[0], 0, LOW[2]), (HIGH[0], tall, LOW[2] + thick), ["front", "top"])
    mesh.box("board", (LOW[0], 0, HIGH[2] - thick), (HIGH[0], tall, HIGH[2]), ["back", "top"])
    return mesh


def window() -> Mesh:
    """A frame with a cross in the opening, and a sill."""
    mesh = Mesh({"frame": plain("f4f1ea")})
    (left, right), (sill, head) = WINDOW
    back, front = LOW[2] - 0.08, LOW[2] + 0.02
    for low, high in (
        ((left, sill), (left + 0.06, head)),
        ((right - 0.06, sill), (right, head)),
        ((left + 0.06, sill), (right - 0.06, sill + 0.06)),
        ((left + 0.06, head - 0.06), (right - 0.06, head)),
        ((-0.02, sill + 0.06), (0.02, head - 0.06)),
    ):
        mesh.box("frame", (*low, back), (*high, front))
    mesh.box("frame", (left - 0.08, sill - 0.04, LOW[2]), (right + 0.08, sill, LOW[2] + 0.18))
    return mesh


def door() -> Mesh:
    """In the wall at +x, 0.85 x 2.05 m, with a frame and a knob."""
    mesh = Mesh(
        {"leaf": panelled("a9744a", 2, 4), "frame": plain("efece4"), "knob": plain("b08d3c")}, {}, {"knob": 200}
    )
    x = HIGH[0]
    mesh.box("leaf", (x - 0.03, 0.0, 0.35), (x, 2.05, 1.2), ["left"])
    for low, high in (((0.0, 0.27), (2.05, 0.35)), ((0.0, 1.2), (2.05, 1.28)), ((2.05, 0.27), (2.13, 1.28))):
        mesh.box("frame", (x - 0.04, *low), (x, *high))
    mesh.box("knob", (x - 0.09, 1.0, 0.42), (x - 0.03, 1.05, 0.47))
    return mesh


def carpet() -> Mesh:
    mesh = Mesh({"weave": rug(), "edge": plain("23395b")})
    low, high = (-0.9, 0.001, -0.45), (0.9, RUG_TOP, 0.75)
    mesh.box("weave", low, high, ["top"])
    mesh.box("edge", low, high, ["left", "right", "front", "back"])
    return mesh


def picture() -> Mesh:
    """On the wall at -x."""
    mesh = Mesh({"canvas": landscape(), "frame": plain("4a3423")})
    x, low, high = LOW[0], (1.25, -0.45), (1.85, 0.45)
    mesh.box("canvas", (x, *low), (x + 0.015, *high), ["right"])
    for a, b in (
        ((low[0] - 0.05, low[1] - 0.05), (low[0], high[1] + 0.05)),
        ((high[0], low[1] - 0.05), (high[0] + 0.05, high[1] + 0.05)),
        ((low[0], low[1] - 0.05), (high[0], low[1])),
        ((low[0], high[1]), (high[0], high[1] + 0.05)),
    ):
        mesh.box("frame", (x, *a), (x + 0.03, *b))
    return mesh


CUPBOARD: Final = ((0.95, 0.08, -1.78), (1.9, 0.86, -1.35))


def cupboard() -> Mesh:
    """Two doors, a top to put things on, and feet."""
    walnut = {"light": "9a6b45", "dark": "5d3a22"}
    textures = {
        "walnut": as_bytes(grained(0.8, 0.8, 128, seed=31, **walnut)),
        "doors": panelled("86593a", 2, 1),
        "brass": plain("c2a14d"),
    }
    mesh = Mesh(textures, {}, {"walnut": 140, "doors": 140, "brass": 200})
    low, high = CUPBOARD
    mesh.box("walnut", low, high, ["left", "right", "top", "bottom"])
    mesh.box("doors", low, high, ["front"])
    for x in (1.36, 1.46):
        mesh.box("brass", (x, 0.45, high[2]), (x + 0.03, 0.51, high[2] + 0.03))
    for x in (low[0], high[0] - 0.06):
        for z in (low[2], high[2] - 0.06):
            mesh.box("walnut", (x, 0.0, z), (x + 0.06, low[1], z + 0.06), ["left", "right", "front", "back"])
    return mesh


PARTS: Final = {
    "ceiling": ceiling,
    "cupboard": cupboard,
    "door": door,
    "floor": floor,
    "picture": picture,
    "rug": carpet,
    "wall": walls,
    "window": window,
}

FURNITURE: Final = (
    # object, x and z of its middle, height of what it stands on, turned about y in degrees
    ("table", 0.0, 0.1, RUG_TOP, 0.0),
    ("chair", -0.45, 0.8, RUG_TOP, 160.0),
    ("chair", 0.55, -0.6, 0.0, 10.0),
    ("teapot", -0.1, 0.1, TABLE_TOP, 35.0),
    ("mug", 0.16, 0.22, TABLE_TOP, -30.0),
    ("book", 0.38, 0.02, TABLE_TOP, 20.0),
    ("lamp", 1.15, -1.56, CUPBOARD[1][1], 0.0),
    ("bottle", 1.6, -1.58, CUPBOARD[1][1], 15.0),
    ("ball", -1.35, -0.9, 0.0, 0.0),
)


def furniture() -> list[dict[str, Any]]:
    """Where the objects that come with Trompe stand."""
    rows = []
    for name, x, z, ground, turned in FURNITURE:
        lowest = min(float(part.vertices[:, 1].min()) for part in load_object(shipped_objects()[name].read()).parts)
        rows.append({"object": name, "position": [x, round(ground - lowest, 4), z], "rotation": [0.0, turned, 0.0]})
    return rows


def scene() -> dict[str, Any]:
    """``scene.json``: all numbers as SAILenv's clients speak them."""
    structure = [{"object": name, "position": [0.0, 0.0, 0.0], "rotation": [0.0, 0.0, 0.0]} for name in sorted(PARTS)]
    sun = {"direction": [0.35, -0.8, 0.48], "intensity": 0.75, "color": [255, 247, 232], "position": [-1.5, 3.0, -2.5]}
    rim = {"direction": [-0.6, -0.5, -0.6], "intensity": 0.12, "position": [2.0, 2.0, 2.0]}
    hanging = {"direction": [0.0, -1.0, 0.0], "intensity": 0.35, "color": [255, 226, 190], "position": [0.0, 1.9, 0.1]}
    return {
        "camera": {"position": [-1.2, 1.5, 1.6], "rotation": [18.0, 148.0, 0.0]},
        "walls": {"low": LOW.tolist(), "high": HIGH.tolist()},
        "ambient": [105, 107, 112],
        "lights": {"Main Light": sun, "Rim Light": rim, "Ceiling Light": {**hanging, "kind": "Point"}},
        "static_objects": structure + furniture(),
    }


def main() -> None:
    """Write the archives and ``scene.json`` into a folder, by default the one that is part of the package."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=FOLDER, help="folder to write to (default: %(default)s)")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    for name, make in PARTS.items():
        data = make().archive(name)
        (options.out / f"{name}.zip").write_bytes(data)
        print(f"{name}: {len(data) / 1e3:.0f} kB")
    (options.out / "scene.json").write_text(json.dumps(scene(), indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
