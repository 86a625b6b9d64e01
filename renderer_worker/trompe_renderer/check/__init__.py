"""Is a renderer right? ``check`` asks it for a few pictures of known objects and names its faults."""

from trompe_renderer.check.engine_render import EngineRender
from trompe_renderer.check.findings import REMEDIES, Finding
from trompe_renderer.check.questions import Render, check

__all__ = ["REMEDIES", "EngineRender", "Finding", "Render", "check"]
