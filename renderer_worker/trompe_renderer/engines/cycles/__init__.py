"""The Cycles engine: Blender's path tracer, in a process of its own."""

from trompe_renderer.engines.cycles.engine import CyclesEngine, CyclesOptions

__all__ = ["CyclesEngine", "CyclesOptions"]
