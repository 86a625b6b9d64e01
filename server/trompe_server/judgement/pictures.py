"""Pictures of a judgement's page."""

import io
from collections.abc import Mapping
from typing import Final

from PIL import Image

from trompe_server.judgement.manifest import Judged
from trompe_server.pictures import difference_strip, texture_sheet, views_sheet

QUALITY: Final = 88
"""Of JPEG: half a megabyte a sheet."""


def judgement_pictures(judged: Judged) -> Mapping[str, bytes]:
    """JPEG files by title: for each renderer the views as the first network sees them, and their change; textures."""
    sheets: dict[str, Image.Image] = {}
    for renderer, images in judged.images.items():
        if judged.judges:
            sheets[f"Views in {renderer}"] = _views(judged, renderer, next(iter(judged.judges)))
        if judged.pair.is_one:
            title = f"Change in {renderer}"
            sheets[title] = difference_strip(images["before"], images["after"], title=title)
    before, after = judged.pair.textures
    if before:
        sheets["Textures"] = texture_sheet(before, after, title="Textures")
    return {title: _jpeg(picture) for title, picture in sheets.items()}


def _views(judged: Judged, renderer: str, network: str) -> Image.Image:
    judge, both, images = judged.judges[network], judged.both(renderer, network), judged.images[renderer]
    assert both is not None  # the renderer has images, and the network was loaded
    return views_sheet(
        (images["before"], images["after"]),
        (judge.verdicts(both[0]), judge.verdicts(both[1])),
        [view.camera for view in judged.views],
        title=f"{network} in {renderer}",
    )


def _jpeg(picture: Image.Image) -> bytes:
    buffer = io.BytesIO()
    picture.convert("RGB").save(buffer, "JPEG", quality=QUALITY, optimize=True)
    return buffer.getvalue()
