"""The Panda3D engine: OpenGL without a screen, fixed-function. Light is worked out at vertices and clipped at white."""

from dataclasses import dataclass
from typing import Annotated, Any, Final

import numpy as np
from click import IntRange
from numpy.typing import NDArray
from panda3d import core

from trompe_renderer.engines.surfaces import (
    ContentCache,
    Pixels,
    Surface,
    background_pixels,
    clipping_planes,
    linear_light,
    surfaces_of,
)
from trompe_renderer.world.snapshot import Matrix, Sky, Snapshot, WorldLight
from trompe_renderer.world.validation import unit_color
from trompe_shared.engine import EngineInfo
from trompe_shared.errors import RendererError
from trompe_shared.geometry import FIELD_OF_VIEW

CONFIGURATION: Final = """
coordinate-system yup-right
window-type offscreen
audio-library-name null
textures-power-2 none
notify-level error
"""


@dataclass(frozen=True)
class Panda3dOptions:
    """``srgb``: light is added up in linear space, else in encoded values, as Panda does by default."""

    srgb: bool = True
    msaa: Annotated[int, IntRange(1, 16)] = 1
    anisotropy: Annotated[int, IntRange(1, 16)] = 1


class Panda3dEngine:
    """One off-screen buffer, reopened for each new size of picture."""

    def __init__(self, options: Panda3dOptions) -> None:
        core.load_prc_file_data("", CONFIGURATION)
        self.info = EngineInfo("panda3d", core.PandaSystem.get_version_string())
        self._options = options
        self._engine = core.GraphicsEngine.get_global_ptr()
        self._pipe = core.GraphicsPipeSelection.get_global_ptr().make_module_pipe("p3headlessgl")
        if self._pipe is None:
            raise RendererError(
                "Panda3D finds no EGL. Install it (Debian and Ubuntu: apt-get install libegl1 libgl1 libgl1-mesa-dri)."
            )
        self._matt = core.Material()
        self._matt.set_ambient((1, 1, 1, 1))
        self._matt.set_diffuse((1, 1, 1, 1))
        self._buffer: _Buffer | None = None
        self._meshes: ContentCache[Any] = ContentCache()
        self._textures: ContentCache[Any] = ContentCache(lambda texture: texture.release_all())

    def render(self, world: Snapshot, *, width: int, height: int) -> NDArray[np.uint8]:
        if self._buffer is None or self._buffer.size != (width, height):
            if self._buffer is not None:
                self._engine.remove_window(self._buffer.output)
            self._buffer = _Buffer(self._engine, self._pipe, self._options, width, height)
        surfaces = list(surfaces_of(world))
        root = core.NodePath("world")
        self._light(root, world)
        for surface in surfaces:
            self._place(root, surface)
        near, far = clipping_planes(world.camera, [surface.ball for surface in surfaces])
        self._buffer.aim(root, world, near=near, far=far)
        self._set_background(self._buffer, world)
        self._engine.render_frame()
        self._meshes.trim()
        self._textures.trim()
        rgb = np.frombuffer(self._buffer.picture.get_ram_image_as("RGB"), np.uint8)
        return rgb.reshape(height, width, 3)[::-1]

    def _set_background(self, buffer: "_Buffer", world: Snapshot) -> None:
        """Clear to the colour, or draw the sky on a card behind everything."""
        sky = isinstance(world.background, Sky)
        buffer.sky.set_active(sky)
        if sky:
            width, height = buffer.size
            image, _ = self._texture(background_pixels(world, width=width, height=height))
            buffer.sky.set_camera(_card(image))
        else:
            color = np.array(world.background)
            buffer.output.set_clear_color((*(linear_light(color) if self._options.srgb else color).tolist(), 1))

    def _light(self, root: Any, world: Snapshot) -> None:
        root.set_antialias(core.AntialiasAttrib.M_multisample)
        ambient = core.AmbientLight("ambient")
        ambient.set_color((*world.ambient, 1))
        for node in (ambient, *map(_light, world.lights)):
            root.set_light(root.attach_new_node(node))

    def _place(self, root: Any, surface: Surface) -> None:
        path = root.attach_new_node("surface")
        path.set_mat(_matrix(surface.pose))
        pixels = surface.albedo.pixels
        path.set_texture(self._textures.get(surface.albedo.key, lambda: self._texture(pixels())))
        path.set_material(self._matt)
        if surface.opacity is not None:
            path.set_transparency(core.TransparencyAttrib.M_alpha)
            path.set_alpha_scale(surface.opacity)
            path.set_depth_write(False)
        else:
            path.set_transparency(core.TransparencyAttrib.M_binary)
        path.attach_new_node(self._meshes.get(surface.key, lambda: _mesh(surface)))

    def _texture(self, pixels: Pixels) -> tuple[Any, int]:
        height, width, channels = pixels.shape
        kinds = {(3, True): "srgb", (4, True): "srgb_alpha", (3, False): "rgb", (4, False): "rgba"}
        texture = core.Texture()
        kind = getattr(core.Texture, f"F_{kinds[channels, self._options.srgb]}")
        texture.setup_2d_texture(width, height, core.Texture.T_unsigned_byte, kind)
        order = [2, 1, 0, 3][:channels]
        texture.set_ram_image(pixels[::-1, :, order].tobytes())
        texture.set_minfilter(core.SamplerState.FT_linear_mipmap_linear)
        texture.set_magfilter(core.SamplerState.FT_linear)
        texture.set_anisotropic_degree(self._options.anisotropy)
        return texture, 2 * pixels.nbytes


class _Buffer:
    """An off-screen buffer of one size: ``sky``, a region, is drawn before the world."""

    def __init__(self, engine: Any, pipe: Any, options: Panda3dOptions, width: int, height: int) -> None:
        self.size = width, height
        properties = core.FrameBufferProperties()
        properties.set_rgba_bits(8, 8, 8, 8)
        properties.set_depth_bits(24)
        properties.set_srgb_color(options.srgb)
        properties.set_multisamples(options.msaa if options.msaa > 1 else 0)
        size = core.WindowProperties.size(width, height)
        self.output = engine.make_output(pipe, "picture", 0, properties, size, core.GraphicsPipe.BF_refuse_window)
        if self.output is None:
            raise RendererError(f"Panda3D cannot open a buffer of {width} x {height} pixels.")
        self.picture = core.Texture()
        self.output.add_render_texture(self.picture, core.GraphicsOutput.RTM_copy_ram)
        self._lens = core.PerspectiveLens()
        across = np.degrees(2 * np.arctan(np.tan(np.radians(FIELD_OF_VIEW / 2)) * width / height))
        self._lens.set_fov(float(across), FIELD_OF_VIEW)
        self._region, self.sky = self.output.make_display_region(), self.output.make_display_region()
        self.sky.set_sort(-1)

    def aim(self, root: Any, world: Snapshot, *, near: float, far: float) -> None:
        """Show ``root`` through the world's camera."""
        self._lens.set_near_far(near, far)
        camera = root.attach_new_node(core.Camera("camera", self._lens))
        camera.set_mat(_matrix(world.camera))
        self._region.set_camera(camera)


def _card(image: Any) -> Any:
    """A camera that sees ``image`` and nothing else."""
    lens = core.OrthographicLens()
    lens.set_film_size(2, 2)
    lens.set_near_far(-1, 1)
    card = core.CardMaker("card")
    card.set_frame_fullscreen_quad()
    root = core.NodePath("card")
    path = root.attach_new_node(card.generate())
    path.set_texture(image)
    path.set_depth_write(False)
    path.set_depth_test(False)
    return root.attach_new_node(core.Camera("camera", lens))


def _matrix(matrix: Matrix) -> Any:
    """Panda multiplies rows."""
    return core.LMatrix4f(*matrix.T.ravel().tolist())


def _light(light: WorldLight) -> Any:
    color = light.intensity * np.array(unit_color(light.color))
    if light.kind == "Point":
        node = core.PointLight("point")
        node.set_point(core.LPoint3(*light.position))
        node.set_attenuation((0, 0, 1))
    else:
        node = core.DirectionalLight("directional")
        node.set_direction(core.LVector3(*light.direction))
    node.set_color((*color.tolist(), 1))
    return node


def _mesh(surface: Surface) -> tuple[Any, int]:
    part = surface.part
    data = core.GeomVertexData("part", core.GeomVertexFormat.get_v3n3t2(), core.Geom.UH_static)
    data.set_num_rows(len(part.vertices))
    rows = np.hstack([part.vertices, part.normals, part.uvs]).astype(np.float32)
    memoryview(data.modify_array(0)).cast("B")[:] = rows.tobytes()
    triangles = core.GeomTriangles(core.Geom.UH_static)
    triangles.set_index_type(core.Geom.NT_uint32)
    corners = triangles.modify_vertices()
    corners.unclean_set_num_rows(part.faces.size)
    memoryview(corners).cast("B")[:] = part.faces.astype(np.uint32).tobytes()
    geom = core.Geom(data)
    geom.add_primitive(triangles)
    node = core.GeomNode(part.material)
    node.add_geom(geom)
    return node, rows.nbytes + 4 * part.faces.size
