"""pyrender's renderer, changed where a worker that shows single objects to a critical eye needs it.

- Objects stay on the card when another scene is drawn (``Uploads`` frees them).
- A shadow map covers exactly the sphere around the objects, its depths carry a bias that grows with the slope of the
  surface (no acne, no light under the feet), and it is drawn again only when light or objects changed.
- Colour alone is read back, not depth.
"""

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from trompe_renderer.platform import GL, pyrender

__all__ = ["ObjectRenderer"]

SHADOW_SIDE: Final = 1024
SLOPE_BIAS: Final = 5.0  # the shader's filter reaches 2.5 texels along both axes, the slope is that of the steeper one
CONSTANT_BIAS: Final = 8.0

Matrix = NDArray[np.float64]


class ObjectRenderer(pyrender.Renderer):  # type: ignore[misc]
    """Draws ``pyrender.Scene``s into an image of any size, 4x multisampled."""

    def __init__(self, *, shadows: bool) -> None:
        super().__init__(1, 1)
        self._flags = pyrender.RenderFlags.OFFSCREEN
        if shadows:
            self._flags |= pyrender.RenderFlags.SHADOWS_DIRECTIONAL
        self._drawn_shadows: dict[Any, Any] = {}
        for alignment in (GL.GL_UNPACK_ALIGNMENT, GL.GL_PACK_ALIGNMENT):
            GL.glPixelStorei(alignment, 1)  # rows of pixels follow each other without gaps, whatever their width

    def picture(self, scene: Any, *, width: int, height: int) -> NDArray[np.uint8]:
        """(height, width, 3) uint8, row 0 on top."""
        self.viewport_width, self.viewport_height = width, height
        image: NDArray[np.uint8] = self.render(scene, self._flags)
        return image

    def _update_context(self, scene: Any, flags: int) -> None:
        primitives = [primitive for mesh in scene.meshes for primitive in mesh.primitives]
        textures = {texture for primitive in primitives for texture in primitive.material.textures}
        if flags & pyrender.RenderFlags.SHADOWS_DIRECTIONAL:
            for light in scene.lights:
                if light.shadow_texture is None:
                    light._generate_shadow_texture(SHADOW_SIDE)
                textures.add(light.shadow_texture)
        for item in [*primitives, *textures]:
            if not item._in_context():
                item._add_to_context()

    def _shadow_mapping_pass(self, scene: Any, light_node: Any, flags: int) -> None:
        pose = scene.get_pose(light_node)
        seen = (pose.tobytes(), tuple((node.mesh, scene.get_pose(node).tobytes()) for node in scene.mesh_nodes))
        if not scene.mesh_nodes or self._drawn_shadows.get(light_node.light) == seen:
            return
        GL.glEnable(GL.GL_POLYGON_OFFSET_FILL)
        GL.glPolygonOffset(SLOPE_BIAS, CONSTANT_BIAS)
        super()._shadow_mapping_pass(scene, light_node, flags)
        GL.glDisable(GL.GL_POLYGON_OFFSET_FILL)
        self._drawn_shadows[light_node.light] = seen

    def _configure_shadow_mapping_viewport(self, light: Any, flags: int) -> None:
        super()._configure_shadow_mapping_viewport(light, flags)
        GL.glViewport(0, 0, SHADOW_SIDE, SHADOW_SIDE)

    def _get_light_cam_matrices(self, scene: Any, light_node: Any, flags: int) -> tuple[Matrix, Matrix]:
        """View and projection of a light that sees the sphere around all objects and nothing else."""
        radius = 0.5 * max(float(scene.scale), 1e-6) * 1.01
        pose = scene.get_pose(light_node).copy()
        pose[:3, 3] = scene.centroid + 2.0 * radius * pose[:3, 2]
        camera = pyrender.OrthographicCamera(xmag=radius, ymag=radius, znear=0.9 * radius, zfar=3.1 * radius)
        return np.linalg.inv(pose), camera.get_projection_matrix()

    def _read_main_framebuffer(self, scene: Any, flags: int) -> NDArray[np.uint8]:
        width, height = self._main_fb_dims
        GL.glBindFramebuffer(GL.GL_READ_FRAMEBUFFER, self._main_fb_ms)
        GL.glBindFramebuffer(GL.GL_DRAW_FRAMEBUFFER, self._main_fb)
        box = (0, 0, width, height)
        GL.glBlitFramebuffer(*box, *box, GL.GL_COLOR_BUFFER_BIT, GL.GL_NEAREST)
        GL.glBindFramebuffer(GL.GL_READ_FRAMEBUFFER, self._main_fb)
        data = GL.glReadPixels(*box, GL.GL_RGB, GL.GL_UNSIGNED_BYTE)
        return np.frombuffer(data, dtype=np.uint8).reshape(height, width, 3)[::-1]
