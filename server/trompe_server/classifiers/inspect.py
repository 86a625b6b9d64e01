"""Read a classifier in a process of its own: ``python -m trompe_server.classifiers.inspect FILE_OR_NAME``.

Prints one JSON line: ``{"white_box": bool, "image_size": [H, W], "n_classes": N, "classes": names or null}``, or
``{"error": "..."}`` with exit code 1.
"""

import json
import sys

import torch

from trompe_server.classifiers.protocol import WhiteBoxClassifier
from trompe_server.classifiers.registry import load_classifier
from trompe_shared.errors import ClassifierError

__all__ = ["describe", "main"]


def describe(path_or_name: str) -> dict[str, object]:
    """What the API stores about a classifier. Raises ``ClassifierError``."""
    classifier = load_classifier(path_or_name)
    return {
        "white_box": isinstance(classifier, WhiteBoxClassifier),
        "image_size": list(classifier.image_size),
        "n_classes": classifier.n_classes,
        "classes": None if classifier.classes is None else list(classifier.classes),
    }


def main() -> int:
    """Print the JSON line for the file or name on the command line; the exit code."""
    torch.set_num_threads(1)
    try:
        found = describe(sys.argv[1])
    except ClassifierError as error:
        found = {"error": str(error)}
    sys.stdout.write(json.dumps(found) + "\n")
    return int("error" in found)


if __name__ == "__main__":
    sys.exit(main())
