"""What happens to an image on its way from a renderer to a network."""

from trompe_server.image_pipelines.pipeline import PIPELINES, SUITE, Drawn, ImagePipeline

__all__ = ["PIPELINES", "SUITE", "Drawn", "ImagePipeline"]
