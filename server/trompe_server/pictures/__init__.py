"""Pictures of a result: functions from arrays to PIL images."""

from trompe_server.pictures.contact_sheet import Verdict, representative, views_sheet
from trompe_server.pictures.difference import difference_strip, texture_sheet
from trompe_server.pictures.histogram import prediction_histogram
from trompe_server.pictures.layout import printable
from trompe_server.pictures.saliency import heat_textures, saliency_object_sheet, saliency_sheet, saliency_texture_sheet

__all__ = [
    "Verdict",
    "difference_strip",
    "heat_textures",
    "prediction_histogram",
    "printable",
    "representative",
    "saliency_object_sheet",
    "saliency_sheet",
    "saliency_texture_sheet",
    "texture_sheet",
    "views_sheet",
]
