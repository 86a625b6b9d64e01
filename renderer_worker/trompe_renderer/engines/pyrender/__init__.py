"""The pyrender engine: physically based rendering over EGL."""

from trompe_renderer.engines.pyrender.engine import PyrenderEngine
from trompe_renderer.engines.pyrender.passes import PyrenderOptions

__all__ = ["PyrenderEngine", "PyrenderOptions"]
