"""OpenGL without a screen, and the shims that pyrender 0.1.45 needs. Import pyrender and GL from here, nowhere else.

pyrender was last released in 2021: it reads the PyOpenGL platform from the environment, uses a name that NumPy 2
dropped, and imports its window, which wants an X library. All of it is set right before the import below.
"""

import ctypes
import os
import sys
from types import ModuleType
from typing import Any, Final

import numpy as np

from trompe_shared.errors import RendererError

__all__ = ["ANISOTROPY", "GL", "MAX_ANISOTROPY", "create_context", "give_memory_back", "pyrender"]

_M_TRIM_THRESHOLD: Final = -1
_M_MMAP_THRESHOLD: Final = -3
_LARGE_BLOCK: Final = 2**20

_EGL_REMEDY: Final = (
    "Install EGL and Mesa (Debian and Ubuntu: apt-get install libegl1 libgl1 libgl1-mesa-dri), or choose another GPU "
    "with EGL_DEVICE_ID."
)


def _prepare() -> None:
    os.environ["PYOPENGL_PLATFORM"] = "egl"
    # Software GL would filter textures in 8 bits; no graphics card does, and it costs nothing.
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
    from pyrender.platforms import egl as _egl
except (ImportError, AttributeError, OSError) as error:
    raise RendererError(f"OpenGL cannot be loaded ({error}). {_EGL_REMEDY}") from error


def give_memory_back() -> None:
    """Have glibc return large blocks to the system at once: left alone it soon keeps those of the largest pictures."""
    libc = ctypes.CDLL(None)
    if hasattr(libc, "mallopt"):
        for parameter in (_M_MMAP_THRESHOLD, _M_TRIM_THRESHOLD):
            libc.mallopt(parameter, _LARGE_BLOCK)


def create_context() -> Any:
    """An off-screen OpenGL context, current in the calling thread, which must be the only one that ever uses it.

    It is never deleted: that would end the display of every context in the process. Raises ``RendererError``.
    """
    try:
        device = _egl.get_device_by_index(int(os.environ.get("EGL_DEVICE_ID", "0")))
        platform = _egl.EGLPlatform(1, 1, device)
        platform.init_context()
    except Exception as error:  # PyOpenGL raises what the driver happens to fail with
        raise RendererError(f"No OpenGL context can be created through EGL ({error!r}). {_EGL_REMEDY}") from error
    return platform
