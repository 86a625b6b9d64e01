"""Target renderers: the black boxes that an attack is made against."""

from trompe_server.target.backdrop import BackdropTarget
from trompe_server.target.fake import FakeTarget
from trompe_server.target.protocol import TargetRenderer
from trompe_server.target.sailenv import SailenvTarget

__all__ = ["BackdropTarget", "FakeTarget", "SailenvTarget", "TargetRenderer"]
