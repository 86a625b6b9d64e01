"""Target renderers: the black boxes of an attack."""

from trompe_server.renderers.backdrop import BackdropTarget, fitted
from trompe_server.renderers.local import local_renderer
from trompe_server.renderers.pool import RendererPool
from trompe_server.renderers.protocol import TargetRenderer
from trompe_shared.sailenv_client import SailenvTarget

__all__ = ["BackdropTarget", "RendererPool", "SailenvTarget", "TargetRenderer", "fitted", "local_renderer"]
