"""The three.js engine, in Chromium."""

from trompe_renderer.engines.three.engine import ThreeEngine, ThreeOptions

__all__ = ["ThreeEngine", "ThreeOptions"]
