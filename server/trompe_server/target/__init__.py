"""Target renderers: the black boxes that an attack is made against."""

from trompe_server.target.backdrop import BackdropTarget, fitted
from trompe_server.target.fake import FakeTarget
from trompe_server.target.pool import RendererPool
from trompe_server.target.protocol import TargetRenderer
from trompe_server.target.sailenv import SailenvTarget

__all__ = ["BackdropTarget", "FakeTarget", "RendererPool", "SailenvTarget", "TargetRenderer", "fitted"]
