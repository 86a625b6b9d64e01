"""Pictures of a result: pure functions from arrays to PIL images."""

from trompe_server.reports.contact_sheet import Verdict, contact_sheet, representative
from trompe_server.reports.difference import difference_strip, texture_sheet
from trompe_server.reports.saliency_sheet import heat_colours, saliency_sheet

__all__ = [
    "Verdict",
    "contact_sheet",
    "difference_strip",
    "heat_colours",
    "representative",
    "saliency_sheet",
    "texture_sheet",
]
