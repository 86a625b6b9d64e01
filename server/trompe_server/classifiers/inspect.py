"""Describe a classifier in a process of its own: ``python -m trompe_server.classifiers.inspect FILE_OR_NAME``.

Prints one JSON line: ``{"white_box": bool, "image_size": [H, W], "n_classes": N, "classes": names or null}``, or
``{"error": "..."}`` with exit code 1.
"""

import json
import sys
from collections.abc import Sequence

import torch

from trompe_server.classifiers.protocol import WhiteBoxClassifier, refusing
from trompe_server.classifiers.registry import load_classifier
from trompe_shared.errors import ClassifierError


def main(arguments: Sequence[str]) -> int:
    """Print the JSON line for the file or name in ``arguments``; return the exit code."""
    try:
        with refusing("It cannot be read", remedy=". Export it again, to .pt2 (torch.export) or .onnx."):
            classifier = load_classifier(arguments[0])
    except ClassifierError as error:
        found: dict[str, object] = {"error": str(error)}
    else:
        found = {
            "white_box": isinstance(classifier, WhiteBoxClassifier),
            "image_size": list(classifier.image_size),
            "n_classes": classifier.n_classes,
            "classes": None if classifier.classes is None else list(classifier.classes),
        }
    sys.stdout.write(json.dumps(found) + "\n")
    return int("error" in found)


if __name__ == "__main__":
    torch.set_num_threads(1)
    sys.exit(main(sys.argv[1:]))
