"""Pictures of a result: functions from arrays to PIL images."""

from trompe_server.pictures.contact_sheet import Verdict, contact_sheet, hardest_and_easiest, representative
from trompe_server.pictures.difference import difference_strip, texture_sheet
from trompe_server.pictures.histogram import prediction_histogram
from trompe_server.pictures.saliency import (
    heat_colours,
    heat_textures,
    saliency_object_sheet,
    saliency_sheet,
    saliency_texture_sheet,
)

__all__ = [
    "Verdict",
    "contact_sheet",
    "difference_strip",
    "hardest_and_easiest",
    "heat_colours",
    "heat_textures",
    "prediction_histogram",
    "representative",
    "saliency_object_sheet",
    "saliency_sheet",
    "saliency_texture_sheet",
    "texture_sheet",
]
