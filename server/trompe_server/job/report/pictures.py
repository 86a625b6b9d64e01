"""Pictures of the report."""

from collections import Counter
from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from trompe_server.job.protocol import THUMBNAIL
from trompe_server.job.report.data import Images, ReportData, distinct_views
from trompe_server.job.setup import JobSetup
from trompe_server.pictures import (
    difference_strip,
    prediction_histogram,
    printable,
    representative,
    saliency_object_sheet,
    saliency_sheet,
    saliency_texture_sheet,
    texture_sheet,
    views_sheet,
)
from trompe_server.system.threads import in_threads
from trompe_shared.engine import DEFAULT_ENGINE
from trompe_shared.object3d import encode_png

SALIENCY_VIEWS: Final = 6
THUMBNAIL_HEIGHT: Final = 112
"""Pixels."""


def picture_files(data: ReportData) -> dict[str, bytes]:
    """All pictures as PNG, by file name."""
    setup = data.setup
    names = " or ".join(repr(_short_name(setup, label)) for label in setup.labels)
    engine = data.renderer.engine.name
    where = f" in {engine}" if engine != DEFAULT_ENGINE or len(setup.renderers) > 1 else ""
    title = f"{setup.object_name} as {names}, {setup.classifier.name}{where}"
    sheets = _saliency(data, f"Saliency of {title}")
    if data.after is not None:
        sheets |= _before_and_after(data, data.after, title)
    return dict(zip(sheets, in_threads(encode_png, sheets.values()), strict=True))


def saliency_views(setup: JobSetup) -> NDArray[np.int64]:
    """The views of the saliency sheets."""
    distinct = distinct_views(setup.views)
    return distinct[representative(len(distinct), SALIENCY_VIEWS)]


def _saliency(data: ReportData, title: str) -> dict[str, Image.Image]:
    setup, maps = data.setup, data.maps
    if maps is None:
        return {}
    some = saliency_views(setup)
    own = data.before["own"][some]
    sheets = {"saliency.png": saliency_sheet(own, maps[some], tau=data.spec.paint.tau, title=title)}
    if data.scores is not None and data.heated is not None:
        sheets["saliency_textures.png"] = saliency_texture_sheet(setup.obj.textures, data.scores, title=title)
        sheets["saliency_object.png"] = saliency_object_sheet(own, maps[some], data.heated, title=title)
    return sheets


def _before_and_after(data: ReportData, after: Images, title: str) -> dict[str, Image.Image]:
    setup, own, distinct = data.setup, data.before["own"], distinct_views(data.setup.views)
    logits_before, logits_after = data.logits_before["own"], (data.logits_after or {})["own"]
    sheets = {
        "contact_sheet.png": views_sheet(
            (own, after["own"]),
            (setup.judge.verdicts(logits_before), setup.judge.verdicts(logits_after)),
            [view.camera for view in setup.views],
            title=f"{title}, epsilon {data.spec.paint.epsilon:g}",
            distinct=distinct.tolist(),
        ),
        "difference.png": difference_strip(own[distinct], after["own"][distinct], title=title),
        "predictions.png": prediction_histogram(
            _counts(logits_before, setup),
            _counts(logits_after, setup),
            labels=[_short_name(setup, label) for label in setup.labels],
            title=f"Predictions for {title}: {len(own)} target views",
        ),
    }
    sheets[THUMBNAIL] = _thumbnail(data, after)
    if data.painted is not None:
        sheets["textures.png"] = texture_sheet(setup.obj.textures, data.painted.textures, title=title)
    return sheets


def _thumbnail(data: ReportData, after: Images) -> Image.Image:
    """A view before and after, side by side: a held-out one if there are any, recognised before and fooled after."""
    kind = "held_out" if data.setup.held_out else "own"
    logits_before, logits_after = data.logits_before[kind], (data.logits_after or {})[kind]
    before, then = map(data.setup.judge.verdicts, (logits_before, logits_after))
    fates = [was.correct + (was.correct and not now.correct) for was, now in zip(before, then, strict=True)]
    view = int(np.argmax(fates))
    pair = np.concatenate([data.before[kind][view], after[kind][view]], axis=1)
    height, width = pair.shape[:2]
    return Image.fromarray(pair).resize((round(THUMBNAIL_HEIGHT * width / height), THUMBNAIL_HEIGHT))


def _counts(logits: NDArray[np.float32], setup: JobSetup) -> Counter[str]:
    """Number of views by the name of the predicted class."""
    return Counter(_short_name(setup, index) for index in logits.argmax(axis=1).tolist())


def _short_name(setup: JobSetup, index: int) -> str:
    """The first of a class's names, with its number if a picture shows another class alike."""
    classes = setup.classifier.classes
    return setup.judge.class_name(index) if classes is None else short_names(tuple(classes))[index]


@lru_cache(maxsize=1)
def short_names(classes: tuple[str, ...]) -> list[str]:
    """What pictures call ``classes``."""
    first = [printable(name.split(",")[0]) for name in classes]
    times = Counter(first)
    return [f"{name} ({k})" if times[name] > 1 or "?" in name else name for k, name in enumerate(first)]
