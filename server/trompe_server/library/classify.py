"""Classify images sent by another process: ``python -m trompe_server.library.classify``, see ``classification``.

A request on standard input is a line of JSON and the images' bytes one after the other; its answer on standard output
is a line of JSON, ``{"found": [[class, probability, probability of the labels], ...]}`` or ``{"error": "..."}``. The
process ends with its input, and after ``IDLE`` seconds without a request.
"""

import json
import os
import select
import sys
from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any, BinaryIO, Final

import numpy as np
import torch
from scipy.special import softmax

from trompe_server.classifiers import Classifier, load_classifier
from trompe_server.image_pipelines import ImagePipeline
from trompe_shared.errors import ClassifierError, ObjectError, SpecError, TrompeError
from trompe_shared.object3d import Texture, decode_rgb

IDLE: Final = 600.0
LOADED: Final = 2
"""Networks in memory."""
MOST_SIDE: Final = 1024
"""Pixels of an image's longer side."""

_network: Final = lru_cache(maxsize=LOADED)(load_classifier)


def main() -> None:
    """Answer the requests on standard input."""
    requests, answers = sys.stdin.buffer, os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what networks print is no answer
    while select.select([requests], [], [], IDLE)[0] and (line := requests.readline()):
        answers.write(json.dumps(answer(json.loads(line), requests)).encode() + b"\n")
        answers.flush()


def answer(asked: Mapping[str, Any], source: BinaryIO) -> dict[str, Any]:
    """The answer to one request, whose images follow in ``source``."""
    sent = [source.read(size) for size in asked["sizes"]]
    try:
        ranges: dict[str, Any] = {name: (value, value) for name, value in asked["strengths"].items()}
        images = ImagePipeline(**ranges).shown(_images(sent))
        return {"found": _classified(_network(asked["network"]), images, asked["labels"])}
    except TrompeError as error:
        return {"error": str(error)}
    except Exception as error:  # of a network, which may raise anything
        return {"error": f"The network does not run on these images ({type(error).__name__}: {str(error)[:300]})."}


def _images(sent: Sequence[bytes]) -> Texture:
    """Images (N, H, W, 3) uint8. Raises ``SpecError`` for unreadable ones and for several sizes."""
    images = [_image(data, number) for number, data in enumerate(sent, 1)]
    sizes = {image.shape[:2] for image in images}
    if len(sizes) > 1:
        raise SpecError(f"The images have different sizes (height, width): {sorted(sizes)}; send images of one size.")
    return np.stack(images)


def _image(data: bytes, number: int) -> Texture:
    try:
        image = decode_rgb(data, f"image {number}")
    except ObjectError as error:
        raise SpecError(f"Image {number} cannot be read. Send a PNG or a JPEG.") from error
    if max(image.shape) > MOST_SIDE:
        raise SpecError(
            f"Image {number} is {image.shape[1]} x {image.shape[0]} pixels; send at most {MOST_SIDE} a side."
        )
    return image


def _classified(network: Classifier, images: Texture, labels: Sequence[int]) -> list[tuple[int, float, float]]:
    if max(labels) >= network.n_classes:
        raise ClassifierError(f"{network.name!r} has {network.n_classes} classes, and none of index {max(labels)}.")
    rows = softmax(network.predict(images).astype(np.float64), axis=-1)
    return [(int(row.argmax()), float(row.max()), float(row[list(labels)].sum())) for row in rows]


if __name__ == "__main__":
    torch.set_num_threads(1)
    main()
