"""The G-buffer pass: instance, depth and motion of each pixel.

It draws the same geometry at pixel centres without blending, so labels are exact: a blended surface is the object.
"""

from collections.abc import Iterable
from typing import Any, Final

import numpy as np

from trompe_renderer.engines.engine import GBuffer
from trompe_renderer.engines.pyrender.blending import BlendedPrimitive
from trompe_renderer.engines.pyrender.platform import GL
from trompe_renderer.engines.pyrender.shaders import Program, framebuffer, renderbuffer
from trompe_renderer.world.snapshot import Matrix
from trompe_shared.opacity import CUTOFF, INVISIBLE

_VERTEX: Final = """
layout(location = 0) in vec3 position;
layout(location = 2) in vec2 place;
uniform mat4 now;
uniform mat4 earlier;
out vec4 seen;
out vec4 was;
out vec2 uv;
void main() {
    uv = place;
    seen = now * vec4(position, 1.0);
    was = earlier * vec4(position, 1.0);
    gl_Position = seen;
}
"""
_FRAGMENT: Final = """
uniform sampler2D albedo;
uniform float cutoff;
uniform float number;
uniform vec2 size;
in vec4 seen;
in vec4 was;
in vec2 uv;
out vec4 found;
void main() {
    if (texture(albedo, uv).a < cutoff) discard;
    vec2 moved = was.w > 0.0 ? (seen.xy / seen.w - was.xy / was.w) * 0.5 * size : vec2(0.0);
    found = vec4(number, seen.w, moved.x, -moved.y);
}
"""


DrawCall = tuple[Any, int, Matrix, Matrix]
"""A pyrender mesh, its instance's number, and the transforms from object to clip space, now and earlier."""


class GBufferPass:
    """Draws G-buffers of any size."""

    def __init__(self) -> None:
        self._program = Program(_VERTEX, _FRAGMENT)
        self._size = (0, 0)
        self._names: tuple[int, ...] = ()

    def draw(self, calls: Iterable[DrawCall], *, width: int, height: int) -> GBuffer:
        """Draw ``calls`` through the camera in their matrices."""
        self._prepare((width, height))
        for mesh, number, now, earlier in calls:
            self._program.use(now=now, earlier=earlier, number=number, size=np.array([width, height]))
            for primitive in mesh.primitives:
                self._program.use(cutoff=INVISIBLE if isinstance(primitive, BlendedPrimitive) else CUTOFF)
                _draw(primitive)
        GL.glUseProgram(0)
        return _read(width, height)

    def _prepare(self, size: tuple[int, int]) -> None:
        """Clear a framebuffer of this size and set the OpenGL state of the pass."""
        if size != self._size:
            self._resize(size)
        GL.glBindFramebuffer(GL.GL_FRAMEBUFFER, self._names[0])
        GL.glViewport(0, 0, *size)
        for feature in (GL.GL_BLEND, GL.GL_MULTISAMPLE, GL.GL_POLYGON_OFFSET_FILL):
            GL.glDisable(feature)
        for feature in (GL.GL_DEPTH_TEST, GL.GL_CULL_FACE):
            GL.glEnable(feature)
        GL.glDepthMask(GL.GL_TRUE)
        GL.glDepthFunc(GL.GL_LESS)
        GL.glCullFace(GL.GL_BACK)
        GL.glPolygonMode(GL.GL_FRONT_AND_BACK, GL.GL_FILL)
        GL.glClearColor(0.0, np.inf, 0.0, 0.0)
        GL.glClear(GL.GL_COLOR_BUFFER_BIT | GL.GL_DEPTH_BUFFER_BIT)

    def _resize(self, size: tuple[int, int]) -> None:
        if self._names:
            GL.glDeleteFramebuffers(1, self._names[:1])
            GL.glDeleteRenderbuffers(2, self._names[1:])
        self._names, self._size = (), (0, 0)
        color = renderbuffer(GL.GL_RGBA32F, size)
        depth = renderbuffer(GL.GL_DEPTH_COMPONENT32F, size)
        self._names, self._size = (framebuffer(color, depth), color, depth), size


def _draw(primitive: Any) -> None:
    albedo = primitive.material.baseColorTexture
    for item in (primitive, albedo):
        if not item._in_context():
            item._add_to_context()
    GL.glActiveTexture(GL.GL_TEXTURE0)
    albedo._bind()
    primitive._bind()
    GL.glDrawElements(primitive.mode, primitive.indices.size, GL.GL_UNSIGNED_INT, None)
    primitive._unbind()


def _read(width: int, height: int) -> GBuffer:
    data = GL.glReadPixels(0, 0, width, height, GL.GL_RGBA, GL.GL_FLOAT)
    found = np.frombuffer(data, np.float32).reshape(height, width, 4)[::-1]
    return GBuffer(found[..., 0].astype(np.int64), found[..., 1], found[..., 2:])
