"""Examples of the OpenAPI document. A test posts the requests and checks the answers against their schemas."""

from functools import partial
from typing import Any, Final

Answers = dict[int | str, dict[str, Any]]


def answer(status: int, description: str, example: Any, **more: Any) -> Answers:
    """One answer with an example."""
    return {status: {"description": description, "content": {"application/json": {"example": example}}, **more}}


found: Final = partial(answer, 200, "Found")
made: Final = partial(answer, 201, "Created")

JOB_REQUESTS: Final[dict[str, Any]] = {
    "shortest": {
        "summary": "The shipped mug against the shipped classifier",
        "value": {"object": "mug", "goal": {"label": "mug"}},
    },
    "labelled": {
        "summary": "A job of a series with low priority, found by its labels",
        "value": {
            "object": "mug",
            "goal": {"label": "mug"},
            "victim": {"classifier": "tiny"},
            "paint": {"epsilon": 0.02},
            "search": {"steps": 60, "seed": 7},
            "priority": "sweep",
            "labels": {"experiment": "mugs", "epsilon": "0.02"},
        },
    },
    "targeted": {
        "summary": "Targeted at a bottle, before two backgrounds, with a fifth of the texels",
        "value": {
            "object": "mug",
            "goal": {"label": "mug", "target": "bottle"},
            "paint": {"keep": 0.2},
            "views": {"background": ["black", "#a0c0e0"]},
        },
    },
}

JUDGEMENT_REQUESTS: Final[dict[str, Any]] = {
    "shortest": {
        "summary": "A shipped object against itself",
        "value": {"before": "mug", "after": "mug", "label": "mug"},
    },
    "suite": {
        "summary": "A suite, with a stated budget",
        "value": {"before": "mug", "after": "mug", "label": "mug", "epsilon": 0.05, "suite": "standard-1"},
    },
}

JOB: Final[dict[str, Any]] = {
    "id": "8f14e45fceea167a",
    "state": "running",
    "spec": {"object": "mug", "goal": {"label": ["mug"]}, "victim": {"classifier": "tiny"}, "paint": {"epsilon": 0.02}},
    "names": {},
    "priority": "sweep",
    "labels": {"experiment": "mugs"},
    "needs": {"cpu": 1.0, "gpu": 0.0, "memory": 0.0},
    "worker": "gpu-1-4711",
    "created": "2026-01-31T12:00:00Z",
    "started": "2026-01-31T12:00:01Z",
    "finished": None,
    "progress": {
        "phase": "attack",
        "fraction": 0.6,
        "step": 18,
        "steps": 30,
        "loss": 1.5,
        "fooled": 0.4,
        "eta_seconds": 12.0,
        "eta_least_seconds": 4.5,
    },
    "attempts": 1,
    "error": None,
    "note": None,
    "artifacts": [],
}
OBJECT: Final = {
    "id": "2c624232cdd221771294dfbb310aca000a0df6ac8b66b696d90ef06fdefb64a3",
    "name": "vase",
    "materials": ["glaze"],
    "textures": {"glaze.png": [512, 512]},
    "triangles": 960,
    "radius": 0.11,
    "shipped": False,
}
CLASSIFIER: Final = {
    "id": "tiny",
    "name": "tiny",
    "white_box": True,
    "image_size": [128, 128],
    "n_classes": 3,
    "classes": ["ball", "bottle", "mug"],
    "shipped": True,
}
BACKGROUND: Final = {"id": "19581e27de7ced00ff1ce50b2047e7a567c76b1cbaebabe5ef03f7c3017bb5b7", "name": "beach"}
WORKER: Final = {
    "id": "gpu-1-3f29c1",
    "host": "gpu-1",
    "device": "16 CPU, 2 GPU",
    "alive": True,
    "started": "2026-01-31T09:00:00Z",
    "seen": "2026-01-31T12:00:03Z",
    "jobs": ["8f14e45fceea167a"],
    "fault": None,
}
EXPERIMENT: Final = {
    "name": "mugs",
    "jobs": {"succeeded": 11, "running": 1, "queued": 4},
    "created": "2026-01-31T11:00:00Z",
}

JUDGEMENT: Final = JOB | {"spec": {"before": "mug", "after": "mug", "label": ["mug"], "epsilon": 0.05}}
JOB_LIST: Final = {"jobs": [JOB], "next_cursor": "41"}
CLASSIFICATIONS: Final = [
    {"index": 5, "name": "mug", "confidence": 0.97, "true_confidence": 0.97, "correct": True},
    {"index": 1, "name": "bottle", "confidence": 0.81, "true_confidence": 0.09, "correct": False},
]
RENDERER: Final = {
    "address": "127.0.0.1:8085",
    "alive": True,
    "engine": "pyrender",
    "version": "0.1.45",
    "settings": "",
}

EVENT_STREAM: Final = (
    'id: 3\nevent: progress\ndata: {"id": 3, "time": "2026-01-31T12:00:00Z", "state": "running", '
    '"progress": {"phase": "attack", "fraction": 0.4}}\n\n'
)
ARCHIVE: Final[dict[str, Any]] = {
    "description": "A zip of all artifacts.",
    "content": {"application/zip": {"schema": {"type": "string", "format": "binary"}}},
}
_ACCURACY: Final = {
    "views": 60,
    "distinct": 50,
    "a_before": 0.95,
    "a_after": 0.05,
    "a_drop": 0.947,
    "a_drop_interval": [0.88, 1.0],
    "a_before_interval": [0.86, 0.98],
    "a_after_interval": [0.02, 0.14],
}
_VIEW: Final = {
    "azimuth": 60.0,
    "elevation": 20.0,
    "distance": 0.35,
    "light_azimuth": 0.0,
    "light_elevation": 75.0,
    "before": 2,
    "before_confidence": 0.97,
    "before_true_confidence": 0.97,
    "after": 1,
    "after_confidence": 0.81,
    "after_true_confidence": 0.09,
}
RESULT: Final[dict[str, Any]] = {
    "spec": {"object": "mug", "goal": {"label": ["mug"]}},
    "object": "mug",
    "label": 2,
    "label_name": "mug",
    "labels": [2],
    "label_names": ["mug"],
    "classifier": "tiny",
    "epsilon": 0.05,
    "alpha": 0.01,
    "tau": 0.05,
    "surrogate_model": "curve",
    "surrogate_reason": "the cheapest within tolerance",
    "seed": 0,
    "steps": 30,
    "image_size": [128, 128],
    "surrogate": _ACCURACY,
    "target": _ACCURACY,
    "held_out": _ACCURACY,
    "transfer_gap": 0.0,
    "disagreement": 0.0,
    "margin_error": 0.02,
    "texels_altered": 0.62,
    "mean_texel_change": 0.031,
    "max_view_change": 0.049,
    "seconds": {"open": 0.4, "prepare": 3.1, "calibrate": 6.4, "attack": 21.0, "judge": 3.0, "report": 2.2},
    "probe_renders": 304,
    "attacked_views": 75,
    "further_renders": 105,
    "versions": {"trompe": "0.2.0"},
    "views": [_VIEW],
    "held_out_views": [_VIEW],
}

_FILE: Final = {"source": "mug", "sha256": "2c624232cdd221771294dfbb310aca00", "bytes": 400_000}
MANIFEST: Final[dict[str, Any]] = {
    "suite": "standard-1",
    "label": ["mug"],
    "epsilon": 0.05,
    "before": _FILE,
    "after": _FILE | {"source": "after.zip"},
    "networks": [{"name": "tiny", "reference": "tiny", "image_size": [128, 128], "labels": [2]}],
    "renderers": [{"name": "pyrender"}],
    "image_size": [128, 128],
    "seed": 0,
    "views": [],
    "findings": [{"kind": "size", "text": "The texture is 512 x 512 texels before and 256 x 256 after."}],
    "textures": [],
    "cells": [{"renderer": "pyrender", "network": "tiny", "pipeline": "as rendered", "accuracy": _ACCURACY}],
    "predictions": [],
    "seconds": 12.5,
    "versions": {"trompe": "0.2.0"},
}

_BYTES: Final = {"content": {"application/octet-stream": {"schema": {"type": "string", "format": "binary"}}}}
PART_ANSWERS: Final[Answers] = {
    206: {"description": "The requested range.", **_BYTES},
    304: {"description": "Unchanged (If-None-Match)."},
}
FILE_ANSWERS: Final[Answers] = {200: {"description": "Found", **_BYTES}, **PART_ANSWERS}
