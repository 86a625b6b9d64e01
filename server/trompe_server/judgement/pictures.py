"""Pictures of a judgement's page."""

import io
from collections.abc import Mapping
from typing import Final

from PIL import Image

from trompe_server.judgement.manifest import Judged
from trompe_server.pictures import (
    contact_sheet,
    difference_strip,
    hardest_and_easiest,
    representative,
    texture_sheet,
)

SHEET_VIEWS: Final = 12
DIFFERENCE_VIEWS: Final = 4
QUALITY: Final = 88
"""Of JPEG: half a megabyte a sheet."""


def judgement_pictures(judged: Judged) -> Mapping[str, bytes]:
    """JPEG files by title: for each renderer the views as the first network sees them, and their change; textures."""
    sheets: dict[str, Image.Image] = {}
    for renderer, images in judged.images.items():
        if judged.judges:
            sheets[f"Views in {renderer}"] = _views(judged, renderer, next(iter(judged.judges)))
        if judged.pair.is_one:
            few = representative(len(judged.views), DIFFERENCE_VIEWS)
            title = f"Change in {renderer}"
            sheets[title] = difference_strip(images["before"][few], images["after"][few], title=title)
    before, after = judged.pair.textures
    if before:
        sheets["Textures"] = texture_sheet(before, after, title="Textures")
    return {title: _jpeg(picture) for title, picture in sheets.items()}


def _views(judged: Judged, renderer: str, network: str) -> Image.Image:
    judge, both, images = judged.judges[network], judged.both(renderer, network), judged.images[renderer]
    assert both is not None  # the renderer has images, and the network was loaded
    old, new = map(judge.verdicts, both)
    recognised = [index for index, verdict in enumerate(old) if verdict.correct]
    cameras = [view.camera for view in judged.views]
    shown = (
        hardest_and_easiest(recognised, new, cameras, SHEET_VIEWS)
        if recognised
        else representative(len(old), SHEET_VIEWS)
    )
    fooled = sum(not new[index].correct for index in recognised)
    return contact_sheet(
        [(images["before"][k], images["after"][k], old[k], new[k]) for k in shown],
        title=f"{network} in {renderer}",
        facts=f"Recognised before in {len(recognised)} of {len(old)} views; {fooled} of these are fooled.",
    )


def _jpeg(picture: Image.Image) -> bytes:
    buffer = io.BytesIO()
    picture.convert("RGB").save(buffer, "JPEG", quality=QUALITY, optimize=True)
    return buffer.getvalue()
