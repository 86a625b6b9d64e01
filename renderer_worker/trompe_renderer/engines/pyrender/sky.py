"""The sky: a full-screen pass behind all objects. For the OpenGL thread only."""

from typing import Final

import numpy as np

from trompe_renderer.engines.pyrender.platform import GL
from trompe_renderer.engines.pyrender.shaders import Program
from trompe_renderer.world.snapshot import Matrix

_VERTEX: Final = """
out vec2 place;
void main() {
    place = vec2(gl_VertexID == 1 ? 3.0 : -1.0, gl_VertexID == 2 ? 3.0 : -1.0);
    gl_Position = vec4(place, 1.0, 1.0);
}
"""
_FRAGMENT: Final = """
uniform mat4 towards;
in vec2 place;
out vec4 color;
void main() {
    float height = normalize((towards * vec4(place, -1.0, 0.0)).xyz).y;
    vec3 horizon = vec3(0.84, 0.89, 0.93), zenith = vec3(0.30, 0.52, 0.78), ground = vec3(0.47, 0.49, 0.43);
    vec3 sky = mix(horizon, zenith, sqrt(clamp(height, 0.0, 1.0)));
    color = vec4(mix(ground, sky, smoothstep(-0.01, 0.01, height)), 1.0);
}
"""


class SkyPass:
    """Fills the samples of the current framebuffer that no object covers."""

    def __init__(self) -> None:
        self._program = Program(_VERTEX, _FRAGMENT)
        self._triangle = GL.glGenVertexArrays(1)

    def draw(self, camera: Matrix, projection: Matrix) -> None:
        """``camera`` (4, 4) is camera-to-world, ``projection`` (4, 4) camera-to-clip."""
        self._program.use(towards=camera @ np.diag([1 / projection[0, 0], 1 / projection[1, 1], 1.0, 1.0]))
        GL.glDisable(GL.GL_CULL_FACE)
        GL.glDisable(GL.GL_BLEND)
        GL.glPolygonMode(GL.GL_FRONT_AND_BACK, GL.GL_FILL)
        GL.glDepthFunc(GL.GL_LEQUAL)
        GL.glBindVertexArray(self._triangle)
        GL.glDrawArrays(GL.GL_TRIANGLES, 0, 3)
        GL.glBindVertexArray(0)
        GL.glUseProgram(0)
