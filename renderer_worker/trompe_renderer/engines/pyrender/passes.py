"""pyrender's renderer, adapted for a worker that shows single objects.

- Objects stay on the GPU when another scene is drawn (``GpuCache`` frees them).
- A shadow map covers exactly the sphere around the objects. Its depths carry a bias that grows with the slope of the
  surface (no acne, no light under the feet). It is redrawn only after lights or objects have changed.
- The sky is drawn behind each sample of a pixel, so edges stay smooth. Blended surfaces follow (``blending``).
- Only colour is read back, not depth.
"""

from dataclasses import dataclass
from typing import Annotated, Any, Final

import numpy as np
from click import IntRange
from numpy.typing import NDArray
from PIL import Image

from trompe_renderer.engines.pyrender.blending import BlendedPrimitive, back_to_front
from trompe_renderer.engines.pyrender.platform import GL, MAX_ANISOTROPY, pyrender
from trompe_renderer.engines.pyrender.shaders import framebuffer, renderbuffer
from trompe_renderer.engines.pyrender.sky import SkyPass
from trompe_renderer.world.snapshot import Background, Matrix, Sky
from trompe_shared.errors import RendererError
from trompe_shared.opacity import CUTOFF

SLOPE_BIAS: Final = 5.0
"""Twice the reach of the shader's filter, 2.5 texels: OpenGL takes the slope of the steeper axis only."""
CONSTANT_BIAS: Final = 8.0


@dataclass(frozen=True)
class PyrenderOptions:
    """docs/worker.md lists effects and costs. ``anisotropy``: longest footprint of texture filters, as a ratio."""

    shadows: bool = True
    shadow_map: Annotated[int, IntRange(64, 16384)] = 1024
    msaa: Annotated[int, IntRange(1, 32)] = 4
    supersample: Annotated[int, IntRange(1, 4)] = 1
    anisotropy: Annotated[int, IntRange(1, 16)] = 1


class ObjectRenderer(pyrender.Renderer):  # type: ignore[misc]
    """Draws ``pyrender.Scene``s into images of any size.

    Raises ``RendererError`` if the driver does not support ``options``.
    """

    _main_fb_dims: tuple[int, int]

    def __init__(self, options: PyrenderOptions) -> None:
        super().__init__(1, 1)
        _check(options)
        self._options = options
        self._flags = pyrender.RenderFlags.OFFSCREEN
        if options.shadows:
            self._flags |= pyrender.RenderFlags.SHADOWS_DIRECTIONAL
        self._drawn_shadows: dict[Any, Any] = {}
        self._sky = SkyPass()
        self._background: Background = (0.0, 0.0, 0.0)
        for alignment in (GL.GL_UNPACK_ALIGNMENT, GL.GL_PACK_ALIGNMENT):
            GL.glPixelStorei(alignment, 1)  # no gaps between rows of pixels, at any width

    def picture(self, scene: Any, *, width: int, height: int, background: Background) -> NDArray[np.uint8]:
        """(height, width, 3) uint8, row 0 on top. A background colour must equal that of ``scene``."""
        factor = self._options.supersample
        self.viewport_width, self.viewport_height = factor * width, factor * height
        self._background = background
        image: NDArray[np.uint8] = self.render(scene, self._flags)
        return image if factor == 1 else np.asarray(Image.fromarray(image).reduce(factor))

    def _update_context(self, scene: Any, flags: int) -> None:
        primitives = [primitive for mesh in scene.meshes for primitive in mesh.primitives]
        textures = {texture for primitive in primitives for texture in primitive.material.textures}
        if flags & pyrender.RenderFlags.SHADOWS_DIRECTIONAL:
            for node in scene.directional_light_nodes:
                if node.light.shadow_texture is None:
                    node.light._generate_shadow_texture(self._options.shadow_map)
                textures.add(node.light.shadow_texture)
        for item in [*primitives, *textures]:
            if not item._in_context():
                item._add_to_context()

    def _shadow_mapping_pass(self, scene: Any, light_node: Any, flags: int) -> None:
        pose = scene.get_pose(light_node)
        seen = (pose.tobytes(), frozenset((node.mesh, scene.get_pose(node).tobytes()) for node in scene.mesh_nodes))
        if not scene.mesh_nodes or self._drawn_shadows.get(light_node.light) == seen:
            return
        GL.glEnable(GL.GL_POLYGON_OFFSET_FILL)
        GL.glPolygonOffset(SLOPE_BIAS, CONSTANT_BIAS)
        super()._shadow_mapping_pass(scene, light_node, flags)
        GL.glDisable(GL.GL_POLYGON_OFFSET_FILL)
        self._drawn_shadows[light_node.light] = seen

    def _configure_shadow_mapping_viewport(self, light: Any, flags: int) -> None:
        super()._configure_shadow_mapping_viewport(light, flags)
        GL.glViewport(0, 0, self._options.shadow_map, self._options.shadow_map)

    def _get_light_cam_matrices(self, scene: Any, light_node: Any, flags: int) -> tuple[Matrix, Matrix]:
        """View and projection (4, 4) of a light that covers exactly the sphere around all objects."""
        radius = 0.5 * max(float(scene.scale), 1e-6) * 1.01
        pose = scene.get_pose(light_node).copy()
        pose[:3, 3] = scene.centroid + 2.0 * radius * pose[:3, 2]
        camera = pyrender.OrthographicCamera(xmag=radius, ymag=radius, znear=0.9 * radius, zfar=3.1 * radius)
        return np.linalg.inv(pose), camera.get_projection_matrix()

    def _configure_main_framebuffer(self) -> None:
        size = self.viewport_width, self.viewport_height
        if self._main_fb_dims == size:
            return
        self._delete_main_framebuffer()
        samples = 0 if self._options.msaa == 1 else self._options.msaa
        kinds = GL.GL_RGBA, GL.GL_DEPTH_COMPONENT24
        self._main_cb, self._main_db = (renderbuffer(kind, size) for kind in kinds)
        self._main_cb_ms, self._main_db_ms = (renderbuffer(kind, size, samples=samples) for kind in kinds)
        self._main_fb = framebuffer(self._main_cb, self._main_db)
        self._main_fb_ms = framebuffer(self._main_cb_ms, self._main_db_ms)
        self._main_fb_dims = size

    def _bind_and_draw_primitive(self, primitive: Any, pose: Matrix, program: Any, flags: int) -> None:
        if not isinstance(primitive, BlendedPrimitive):  # those are drawn last, and cast no shadow
            super()._bind_and_draw_primitive(primitive, pose, program, flags)

    def _draw_blended(self, scene: Any, flags: int) -> None:
        """Composite the blended surfaces over the image, back to front."""
        if not any(mesh.is_transparent for mesh in scene.meshes):
            return
        nodes = [(primitive, node) for node in self._sorted_mesh_nodes(scene) for primitive in node.mesh.primitives]
        nodes = [(primitive, node) for primitive, node in nodes if isinstance(primitive, BlendedPrimitive)]
        surfaces = [(primitive, scene.get_pose(node)) for primitive, node in nodes]
        view, projection = self._get_camera_matrices(scene)
        eye = scene.get_pose(scene.main_camera_node)[:3, 3]
        GL.glDepthFunc(GL.GL_LESS)
        GL.glDepthMask(GL.GL_FALSE)
        for number, faces in back_to_front(surfaces, view):
            primitive, pose = surfaces[number]
            primitive.show(faces)
            program = self._get_primitive_program(primitive, flags, pyrender.constants.ProgramFlags.USE_MATERIAL)
            program._bind()
            for name, value in (("V", view), ("P", projection), ("cam_pos", eye), ("cutoff", 0.0)):
                program.set_uniform(name, value)
            self._bind_lighting(scene, program, nodes[number][1], flags)
            super()._bind_and_draw_primitive(primitive, pose, program, flags)
            self._reset_active_textures()
            program.set_uniform("cutoff", CUTOFF)
            program._unbind()
        GL.glDepthMask(GL.GL_TRUE)
        for primitive, _ in surfaces:
            primitive.show(slice(None))

    def _read_main_framebuffer(self, scene: Any, flags: int) -> NDArray[np.uint8]:
        width, height = self.viewport_width, self.viewport_height
        if isinstance(self._background, Sky):
            self._sky.draw(scene.get_pose(scene.main_camera_node), self._get_camera_matrices(scene)[1])
        self._draw_blended(scene, flags)
        GL.glBindFramebuffer(GL.GL_READ_FRAMEBUFFER, self._main_fb_ms)
        GL.glBindFramebuffer(GL.GL_DRAW_FRAMEBUFFER, self._main_fb)
        box = (0, 0, width, height)
        GL.glBlitFramebuffer(*box, *box, GL.GL_COLOR_BUFFER_BIT, GL.GL_NEAREST)
        GL.glBindFramebuffer(GL.GL_READ_FRAMEBUFFER, self._main_fb)
        data = GL.glReadPixels(*box, GL.GL_RGB, GL.GL_UNSIGNED_BYTE)
        return np.frombuffer(data, dtype=np.uint8).reshape(height, width, 3)[::-1]


def _check(options: PyrenderOptions) -> None:
    limits = {
        "MSAA samples": (options.msaa, GL.GL_MAX_SAMPLES),
        "shadow map": (options.shadow_map, GL.GL_MAX_TEXTURE_SIZE),
    }
    if options.anisotropy > 1:  # by an optional extension
        limits["anisotropy"] = (options.anisotropy, MAX_ANISOTROPY)
    for what, (wanted, name) in limits.items():
        most = int(GL.glGetIntegerv(name))
        if wanted > most:
            raise RendererError(f"{what}: {wanted} is more than this driver's limit of {most}. Choose {most} or less.")
