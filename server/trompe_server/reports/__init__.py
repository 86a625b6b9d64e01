"""Pictures of a result: pure functions from arrays to PIL images."""

from trompe_server.reports.contact_sheet import Verdict, contact_sheet, representative
from trompe_server.reports.difference import difference_strip, texture_sheet
from trompe_server.reports.heat import heat_colours
from trompe_server.reports.histogram import prediction_histogram
from trompe_server.reports.saliency_sheet import saliency_sheet
from trompe_server.reports.saliency_texture import heat_textures, saliency_object_sheet, saliency_texture_sheet
from trompe_server.reports.transfer import TransferMatrix, transfer_matrix, transfer_picture

__all__ = [
    "TransferMatrix",
    "Verdict",
    "contact_sheet",
    "difference_strip",
    "heat_colours",
    "heat_textures",
    "prediction_histogram",
    "representative",
    "saliency_object_sheet",
    "saliency_sheet",
    "saliency_texture_sheet",
    "texture_sheet",
    "transfer_matrix",
    "transfer_picture",
]
