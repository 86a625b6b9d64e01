"""Blender's side of the Cycles engine: a script for a Python with ``bpy``, which may have no Trompe.

A request is a line of JSON, {"call": name, "values": {...}, "arrays": {name: [dtype, shape]}}, and the arrays' bytes.
The answer is a line {"size": n} and n bytes, or {"error": text}. The world is y up, Blender's z up.
"""

import ctypes
import json
import math
import os
import signal
import sys
import tempfile
from typing import IO, Any

import bpy
import numpy
from mathutils import Matrix, Vector

PR_SET_PDEATHSIG = 1
Z_UP = Matrix.Rotation(math.pi / 2, 4, "X")

Json = dict[str, Any]


class Blender:
    """Meshes and images by key; ``draw`` builds the scene of them. ``picture``: the path of the PNG."""

    def __init__(self, picture: str, values: Json) -> None:
        self._picture = picture
        self._meshes: Json = {}
        self._images: Json = {}
        bpy.ops.wm.read_factory_settings(use_empty=True)
        scene = self._scene = bpy.context.scene
        scene.render.engine = "CYCLES"
        scene.render.film_transparent = True
        scene.render.resolution_percentage = 100
        scene.render.dither_intensity = 0
        scene.render.filepath = picture
        image = scene.render.image_settings
        image.file_format, image.color_mode, image.color_depth, image.compression = "PNG", "RGBA", "8", 0
        scene.view_settings.view_transform = values["view"]
        scene.cycles.samples = values["samples"]
        scene.cycles.use_denoising = False
        scene.world = bpy.data.worlds.new("world")
        scene.world.use_nodes = True

    def mesh(self, key: str, vertices: Any, normals: Any, uvs: Any, faces: Any) -> None:
        mesh = self._meshes[key] = bpy.data.meshes.new("mesh")
        corners = faces.ravel()
        mesh.vertices.add(len(vertices))
        mesh.vertices.foreach_set("co", vertices.ravel())
        mesh.loops.add(len(corners))
        mesh.loops.foreach_set("vertex_index", corners)
        mesh.polygons.add(len(faces))
        mesh.polygons.foreach_set("loop_start", numpy.arange(0, len(corners), 3, dtype=numpy.int32))
        mesh.uv_layers.new().uv.foreach_set("vector", uvs[corners].ravel())
        mesh.update(calc_edges=True)
        mesh.shade_smooth()
        mesh.normals_split_custom_set_from_vertices(normals)
        mesh.materials.append(None)

    def image(self, key: str, color: bool, pixels: Any) -> None:
        """pixels (H, W, 4) uint8, bottom row first."""
        image = self._images[key] = bpy.data.images.new("image", pixels.shape[1], pixels.shape[0], alpha=True)
        image.colorspace_settings.name = "sRGB" if color else "Non-Color"
        image.alpha_mode = "CHANNEL_PACKED"
        image.pixels.foreach_set((pixels / numpy.float32(255)).ravel())
        image.pack()

    def drop(self, key: str) -> None:
        for kept, data in ((self._meshes, bpy.data.meshes), (self._images, bpy.data.images)):
            if key in kept:
                data.remove(kept.pop(key))

    def draw(self, world: Json) -> bytes:
        """The picture as PNG, with transparency where nothing is."""
        for data in (bpy.data.objects, bpy.data.materials, bpy.data.lights, bpy.data.cameras):
            for each in list(data):
                data.remove(each)
        self._aim(world)
        background = self._scene.world.node_tree.nodes["Background"]
        background.inputs["Color"].default_value = (*world["ambient"], 1)
        for light in world["lights"]:
            self._light(light)
        for item in world["items"]:
            placed = self._add(self._meshes[item["mesh"]], item["pose"])
            placed.material_slots[0].link = "OBJECT"
            placed.material_slots[0].material = self._material(item)
        bpy.ops.render.render(write_still=True)
        with open(self._picture, "rb") as file:
            return file.read()

    def _add(self, data: Any, pose: Any) -> Any:
        placed = bpy.data.objects.new("object", data)
        placed.matrix_world = Z_UP @ Matrix(pose)
        self._scene.collection.objects.link(placed)
        return placed

    def _aim(self, world: Json) -> None:
        camera = bpy.data.cameras.new("camera")
        camera.sensor_fit, camera.angle_y = "VERTICAL", math.radians(world["fov"])
        camera.clip_start, camera.clip_end = world["clip"]
        self._scene.camera = self._add(camera, world["camera"])
        self._scene.cycles.seed = world["seed"]
        self._scene.render.resolution_x, self._scene.render.resolution_y = world["size"]

    def _light(self, light: Json) -> None:
        """Sun: watts a square metre. Point: watts in all directions, of which 4 pi^2 light a surface at 1 m by pi."""
        sun = light["kind"] == "Directional"
        lamp = bpy.data.lights.new("light", "SUN" if sun else "POINT")
        lamp.color = light["color"]
        lamp.energy = light["intensity"] * (math.pi if sun else 4 * math.pi**2)
        if sun:
            lamp.angle = 0
            pose = Vector(light["direction"]).to_track_quat("-Z", "Y").to_matrix().to_4x4()
        else:
            lamp.shadow_soft_size = 0
            pose = Matrix.Translation(light["position"])
        self._add(lamp, pose)

    def _material(self, item: Json) -> Any:
        material = bpy.data.materials.new("material")
        material.use_nodes = True
        nodes, link = material.node_tree.nodes, material.node_tree.links.new
        surface = next(node for node in nodes if node.type == "BSDF_PRINCIPLED")

        def texture(key: str) -> Any:
            node = nodes.new("ShaderNodeTexImage")
            node.image = self._images[key]
            return node

        albedo = texture(item["albedo"])
        link(albedo.outputs["Color"], surface.inputs["Base Color"])
        surface.inputs["Roughness"].default_value = item["roughness"]
        if item["alpha"]:
            alpha = nodes.new("ShaderNodeMath")
            cut = item["opacity"] is None
            alpha.operation = "GREATER_THAN" if cut else "MULTIPLY"
            alpha.inputs[1].default_value = item["cutoff"] if cut else item["opacity"]
            link(albedo.outputs["Alpha"], alpha.inputs[0])
            link(alpha.outputs[0], surface.inputs["Alpha"])
        if item["metallic"]:
            split = nodes.new("ShaderNodeSeparateColor")
            link(texture(item["metallic"]).outputs["Color"], split.inputs[0])
            link(split.outputs[1], surface.inputs["Roughness"])
            link(split.outputs[2], surface.inputs["Metallic"])
        if item["normal"]:
            bumps = nodes.new("ShaderNodeNormalMap")
            link(texture(item["normal"]).outputs["Color"], bumps.inputs["Color"])
            link(bumps.outputs[0], surface.inputs["Normal"])
        return material


def main() -> None:
    """Answer requests until standard input ends. Blender's own messages go nowhere."""
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    with tempfile.TemporaryDirectory() as folder:
        blender = None
        while line := sys.stdin.buffer.readline():
            request = json.loads(line)
            arrays = {name: _array(sys.stdin.buffer, *kind) for name, kind in request["arrays"].items()}
            try:
                if blender is None:
                    blender = Blender(f"{folder}/picture.png", request["values"])
                    data = bpy.app.version_string.encode()
                else:
                    data = getattr(blender, request["call"])(**request["values"], **arrays) or b""
                answers.write(json.dumps({"size": len(data)}).encode() + b"\n" + data)
            except Exception as error:
                answers.write(json.dumps({"error": repr(error)}).encode() + b"\n")
            answers.flush()


def _array(source: IO[bytes], kind: str, shape: list[int]) -> Any:
    size = numpy.dtype(kind).itemsize * math.prod(shape)
    return numpy.frombuffer(source.read(size), kind).reshape(shape)


if __name__ == "__main__":
    main()
