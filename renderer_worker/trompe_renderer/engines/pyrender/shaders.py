"""OpenGL programs and framebuffers, beside pyrender's own. For the OpenGL thread only.

Names of OpenGL objects are plain ints.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from trompe_renderer.engines.pyrender.platform import GL
from trompe_shared.errors import RendererError


class Program:
    """A vertex and a fragment shader. Raises ``RendererError`` if the driver rejects them."""

    def __init__(self, vertex: str, fragment: str) -> None:
        self._name = GL.glCreateProgram()
        for kind, source in ((GL.GL_VERTEX_SHADER, vertex), (GL.GL_FRAGMENT_SHADER, fragment)):
            GL.glAttachShader(self._name, _compiled(kind, source))
        GL.glLinkProgram(self._name)
        if not GL.glGetProgramiv(self._name, GL.GL_LINK_STATUS):
            raise RendererError(f"The driver cannot link a shader program: {GL.glGetProgramInfoLog(self._name)!r}.")

    def use(self, **uniforms: float | NDArray[Any]) -> None:
        """Make the program current and set uniforms: floats, (2,) vectors, (4, 4) matrices."""
        GL.glUseProgram(self._name)
        setters = {(): GL.glUniform1fv, (2,): GL.glUniform2fv}
        for name, value in uniforms.items():
            place, array = GL.glGetUniformLocation(self._name, name), np.asarray(value, np.float32)
            if array.shape == (4, 4):
                GL.glUniformMatrix4fv(place, 1, GL.GL_TRUE, array)
            else:
                setters[array.shape](place, 1, array)


def _compiled(kind: Any, source: str) -> int:
    shader: int = GL.glCreateShader(kind)
    GL.glShaderSource(shader, "#version 330 core\n" + source)
    GL.glCompileShader(shader)
    if not GL.glGetShaderiv(shader, GL.GL_COMPILE_STATUS):
        raise RendererError(f"The driver cannot compile a shader: {GL.glGetShaderInfoLog(shader)!r}.")
    return shader


def renderbuffer(kind: Any, size: tuple[int, int], *, samples: int = 0) -> int:
    """A renderbuffer of internal format ``kind``; ``size`` is (width, height) in pixels."""
    name: int = GL.glGenRenderbuffers(1)
    GL.glBindRenderbuffer(GL.GL_RENDERBUFFER, name)
    GL.glRenderbufferStorageMultisample(GL.GL_RENDERBUFFER, samples, kind, *size)
    return name


def framebuffer(color: int, depth: int) -> int:
    """A framebuffer of two renderbuffers, bound for drawing. Raises ``RendererError`` if the driver rejects it."""
    name: int = GL.glGenFramebuffers(1)
    GL.glBindFramebuffer(GL.GL_DRAW_FRAMEBUFFER, name)
    for place, buffer in ((GL.GL_COLOR_ATTACHMENT0, color), (GL.GL_DEPTH_ATTACHMENT, depth)):
        GL.glFramebufferRenderbuffer(GL.GL_DRAW_FRAMEBUFFER, place, GL.GL_RENDERBUFFER, buffer)
    if GL.glCheckFramebufferStatus(GL.GL_DRAW_FRAMEBUFFER) != GL.GL_FRAMEBUFFER_COMPLETE:
        raise RendererError("The driver cannot draw an image of this size. Ask for a smaller one.")
    return name
