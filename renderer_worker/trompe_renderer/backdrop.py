"""What stands behind all objects, if it is more than a colour. Only the thread that owns the context may come here."""

from collections import OrderedDict
from typing import Final

import numpy as np

from trompe_renderer.platform import GL
from trompe_renderer.scenery import Matrix, Photograph, Sky
from trompe_renderer.shaders import Program

__all__ = ["BackdropPass"]

CAPACITY: Final = 8
"""Photographs that stay on the card."""

_EVERYWHERE: Final = """
out vec2 place;
void main() {
    place = vec2(gl_VertexID == 1 ? 3.0 : -1.0, gl_VertexID == 2 ? 3.0 : -1.0);
    gl_Position = vec4(place, 1.0, 1.0);
}
"""
_SKY: Final = """
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
_PHOTOGRAPH: Final = """
uniform sampler2D photograph;
uniform vec2 size;
out vec4 color;
void main() {
    vec2 texels = vec2(textureSize(photograph, 0)) / size;
    color = texelFetch(photograph, ivec2(gl_FragCoord.xy * texels), 0);
}
"""


class BackdropPass:
    """Fills the samples of the current framebuffer that nothing has been drawn into."""

    def __init__(self) -> None:
        self._sky, self._photograph = Program(_EVERYWHERE, _SKY), Program(_EVERYWHERE, _PHOTOGRAPH)
        self._textures: OrderedDict[str, int] = OrderedDict()
        self._triangle = GL.glGenVertexArrays(1)

    def draw(self, backdrop: Sky | Photograph, camera: Matrix, projection: Matrix, *, size: tuple[int, int]) -> None:
        """``camera`` (4, 4) is camera-to-world; ``size`` is the framebuffer's (width, height)."""
        if isinstance(backdrop, Sky):
            self._sky.use(towards=camera @ np.diag([1 / projection[0, 0], 1 / projection[1, 1], 1.0, 1.0]))
        else:
            GL.glActiveTexture(GL.GL_TEXTURE0)
            GL.glBindTexture(GL.GL_TEXTURE_2D, self._texture(backdrop))
            self._photograph.use(size=np.array(size))
        GL.glDisable(GL.GL_CULL_FACE)
        GL.glDisable(GL.GL_BLEND)
        GL.glPolygonMode(GL.GL_FRONT_AND_BACK, GL.GL_FILL)
        GL.glDepthFunc(GL.GL_LEQUAL)
        GL.glBindVertexArray(self._triangle)
        GL.glDrawArrays(GL.GL_TRIANGLES, 0, 3)
        GL.glBindVertexArray(0)
        GL.glUseProgram(0)

    def _texture(self, photograph: Photograph) -> int:
        if photograph.key not in self._textures:
            self._textures[photograph.key] = _upload(photograph)
            if len(self._textures) > CAPACITY:
                GL.glDeleteTextures(1, [self._textures.popitem(last=False)[1]])
        self._textures.move_to_end(photograph.key)
        return self._textures[photograph.key]


def _upload(photograph: Photograph) -> int:
    """A texture of the photograph, with the bottom row first as OpenGL counts."""
    pixels = np.ascontiguousarray(photograph.pixels[::-1])
    name: int = GL.glGenTextures(1)
    GL.glBindTexture(GL.GL_TEXTURE_2D, name)
    for setting in (GL.GL_TEXTURE_MIN_FILTER, GL.GL_TEXTURE_MAG_FILTER):
        GL.glTexParameteri(GL.GL_TEXTURE_2D, setting, GL.GL_NEAREST)
    size = pixels.shape[1], pixels.shape[0]
    GL.glTexImage2D(GL.GL_TEXTURE_2D, 0, GL.GL_RGB8, *size, 0, GL.GL_RGB, GL.GL_UNSIGNED_BYTE, pixels)
    return name
