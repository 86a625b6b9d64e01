"""pyrender's renderer, changed where a worker that shows single objects to a critical eye needs it.

- Objects stay on the card when another scene is drawn (``Uploads`` frees them).
- A shadow map covers exactly the sphere around the objects, its depths carry a bias that grows with the slope of the
  surface (no acne, no light under the feet), and it is drawn again only when light or objects changed.
- What no object covers is filled with a backdrop, behind each sample of a pixel, so that edges stay smooth.
- Colour alone is read back, not depth.
"""

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from trompe_renderer.backdrop import BackdropPass
from trompe_renderer.options import Quality
from trompe_renderer.platform import GL, MAX_ANISOTROPY, pyrender
from trompe_renderer.scenery import Backdrop
from trompe_renderer.shaders import framebuffer, renderbuffer
from trompe_shared.errors import RendererError

__all__ = ["ObjectRenderer"]

SLOPE_BIAS: Final = 5.0  # the shader's filter reaches 2.5 texels along both axes, the slope is that of the steeper one
CONSTANT_BIAS: Final = 8.0

Matrix = NDArray[np.float64]


class ObjectRenderer(pyrender.Renderer):  # type: ignore[misc]
    """Draws ``pyrender.Scene``s into images of any size.

    Raises ``RendererError`` if the driver cannot do ``quality``.
    """

    _main_fb_dims: tuple[int, int]

    def __init__(self, quality: Quality) -> None:
        super().__init__(1, 1)
        _check(quality)
        self._quality = quality
        self._flags = pyrender.RenderFlags.OFFSCREEN
        if quality.shadows:
            self._flags |= pyrender.RenderFlags.SHADOWS_DIRECTIONAL
        self._drawn_shadows: dict[Any, Any] = {}
        self._backdrops = BackdropPass()
        self._backdrop: Backdrop = (0.0, 0.0, 0.0)
        for alignment in (GL.GL_UNPACK_ALIGNMENT, GL.GL_PACK_ALIGNMENT):
            GL.glPixelStorei(alignment, 1)  # rows of pixels follow each other without gaps, whatever their width

    def picture(self, scene: Any, *, width: int, height: int, backdrop: Backdrop) -> NDArray[np.uint8]:
        """(height, width, 3) uint8, row 0 on top. A backdrop that is a colour must be the scene's own."""
        factor = self._quality.supersample
        self.viewport_width, self.viewport_height = factor * width, factor * height
        self._backdrop = backdrop
        image: NDArray[np.uint8] = self.render(scene, self._flags)
        return image if factor == 1 else np.asarray(Image.fromarray(image).reduce(factor))

    def _update_context(self, scene: Any, flags: int) -> None:
        primitives = [primitive for mesh in scene.meshes for primitive in mesh.primitives]
        textures = {texture for primitive in primitives for texture in primitive.material.textures}
        if flags & pyrender.RenderFlags.SHADOWS_DIRECTIONAL:
            for node in scene.directional_light_nodes:
                if node.light.shadow_texture is None:
                    node.light._generate_shadow_texture(self._quality.shadow_map)
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
        GL.glViewport(0, 0, self._quality.shadow_map, self._quality.shadow_map)

    def _get_light_cam_matrices(self, scene: Any, light_node: Any, flags: int) -> tuple[Matrix, Matrix]:
        """View and projection of a light that sees the sphere around all objects and nothing else."""
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
        samples = 0 if self._quality.msaa == 1 else self._quality.msaa
        kinds = GL.GL_RGBA, GL.GL_DEPTH_COMPONENT24
        self._main_cb, self._main_db = (renderbuffer(kind, size) for kind in kinds)
        self._main_cb_ms, self._main_db_ms = (renderbuffer(kind, size, samples=samples) for kind in kinds)
        self._main_fb = framebuffer(self._main_cb, self._main_db)
        self._main_fb_ms = framebuffer(self._main_cb_ms, self._main_db_ms)
        self._main_fb_dims = size

    def _read_main_framebuffer(self, scene: Any, flags: int) -> NDArray[np.uint8]:
        width, height = self.viewport_width, self.viewport_height
        if not isinstance(self._backdrop, tuple):
            pose, projection = (scene.get_pose(scene.main_camera_node), self._get_camera_matrices(scene)[1])
            self._backdrops.draw(self._backdrop, pose, projection, size=(width, height))
        GL.glBindFramebuffer(GL.GL_READ_FRAMEBUFFER, self._main_fb_ms)
        GL.glBindFramebuffer(GL.GL_DRAW_FRAMEBUFFER, self._main_fb)
        box = (0, 0, width, height)
        GL.glBlitFramebuffer(*box, *box, GL.GL_COLOR_BUFFER_BIT, GL.GL_NEAREST)
        GL.glBindFramebuffer(GL.GL_READ_FRAMEBUFFER, self._main_fb)
        data = GL.glReadPixels(*box, GL.GL_RGB, GL.GL_UNSIGNED_BYTE)
        return np.frombuffer(data, dtype=np.uint8).reshape(height, width, 3)[::-1]


def _check(quality: Quality) -> None:
    limits = {
        "MSAA samples": (quality.msaa, GL.GL_MAX_SAMPLES),
        "shadow map": (quality.shadow_map, GL.GL_MAX_TEXTURE_SIZE),
        "anisotropy": (quality.anisotropy, MAX_ANISOTROPY),
    }
    if quality.anisotropy == 1:
        del limits["anisotropy"]  # which drivers need not know
    for what, (wanted, name) in limits.items():
        most = int(GL.glGetIntegerv(name))
        if wanted > most:
            raise RendererError(f"{what}: {wanted} is more than this driver's {most}. Choose {most} or less.")
