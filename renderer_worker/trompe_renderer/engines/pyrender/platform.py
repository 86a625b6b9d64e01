"""OpenGL without a screen, and shims for pyrender 0.1.45. All imports of pyrender and GL go through this module.

pyrender was last released in 2021: it reads the PyOpenGL platform from the environment, uses a name that NumPy 2
dropped, and imports its window, which needs an X library. ``_prepare`` mends all three before the import. It also
draws the alpha mode MASK as opaque; ``_shader`` adds an alpha test, whose ``cutoff`` is 0 while blended surfaces are
drawn. Textures without alpha have an alpha of 1, so opaque surfaces do not change. Shadows ignore alpha.
"""

import os
import sys
from types import ModuleType
from typing import Any, Final

import numpy as np

from trompe_shared.errors import RendererError
from trompe_shared.opacity import CUTOFF

__all__ = ["ANISOTROPY", "GL", "MAX_ANISOTROPY", "create_context", "pyrender"]

_EGL_REMEDY: Final = (
    "Install EGL and Mesa (Debian and Ubuntu: apt-get install libegl1 libgl1 libgl1-mesa-dri), or choose another GPU "
    "with EGL_DEVICE_ID."
)


def _prepare() -> None:
    os.environ["PYOPENGL_PLATFORM"] = "egl"
    # By default software GL filters textures in 8 bits, unlike a GPU; the full precision costs nothing.
    os.environ.setdefault("GALLIVM_PERF", "no_aos_sampling")
    vars(np).setdefault("infty", np.inf)
    viewer = ModuleType("pyrender.viewer")
    viewer.Viewer = None  # type: ignore[attr-defined]
    sys.modules["pyrender.viewer"] = viewer


_prepare()
try:
    import pyrender
    from OpenGL import GL
    from OpenGL.GL.EXT.texture_filter_anisotropic import GL_MAX_TEXTURE_MAX_ANISOTROPY_EXT as MAX_ANISOTROPY
    from OpenGL.GL.EXT.texture_filter_anisotropic import GL_TEXTURE_MAX_ANISOTROPY_EXT as ANISOTROPY
    from OpenGL.plugins import FormatHandler
    from pyrender.platforms import egl as _egl
    from pyrender.shader_program import ShaderProgram
except (ImportError, AttributeError, OSError) as error:
    raise RendererError(f"OpenGL cannot be loaded ({error}). {_EGL_REMEDY}") from error

# The PyOpenGL that pyrender asks for knows what ``byref`` returns by its name before Python 3.12.
FormatHandler("byref", "OpenGL.arrays.ctypesparameters.CtypesParameterHandler", ["_ctypes.CArgObject"])

_SHADER: Final = "mesh.frag"
_READ: Final = "base_color = base_color * srgb_to_linear(texture(material.base_color_texture, uv_0));"
"""The line of pyrender's shader that reads the albedo."""
_load = ShaderProgram._load


def _shader(program: Any, file: str) -> str:
    text: str = _load(program, file)
    if not file.endswith(_SHADER):
        return text
    if text.count(_READ) != 1:
        raise RendererError(f"pyrender's {_SHADER} is not that of version 0.1.45. Install pyrender==0.1.45.")
    text = text.replace("void main()", f"uniform float cutoff = {CUTOFF};\nvoid main()")
    return text.replace(_READ, f"{_READ}\n    if (base_color.a < cutoff) discard;")


ShaderProgram._load = _shader


def create_context() -> Any:
    """An off-screen OpenGL context, current in the calling thread and bound to it.

    It is never deleted: that would end the display of every context in the process. Raises ``RendererError``.
    """
    try:
        device = _egl.get_device_by_index(int(os.environ.get("EGL_DEVICE_ID", "0")))
        platform = _egl.EGLPlatform(1, 1, device)
        platform.init_context()
    except Exception as error:  # PyOpenGL raises errors of many types
        raise RendererError(f"No OpenGL context can be created through EGL ({error!r}). {_EGL_REMEDY}") from error
    return platform
