"""What happens to an image on its way from a renderer to a network."""

from trompe_server.image_pipelines.pipeline import Drawn, ImagePipeline
from trompe_server.image_pipelines.presets import PIPELINES, SUITE

__all__ = ["PIPELINES", "SUITE", "Drawn", "ImagePipeline"]
