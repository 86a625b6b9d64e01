"""One way in: a file or a name becomes a classifier."""

from collections.abc import Sequence
from pathlib import Path

from trompe_server.classifiers.exported import load_exported
from trompe_server.classifiers.network import NetworkClassifier
from trompe_server.classifiers.onnx import load_onnx
from trompe_server.classifiers.protocol import Classifier
from trompe_server.classifiers.tiny import CLASSES, IMAGE_SIZE, load_tiny
from trompe_shared.errors import ClassifierError

__all__ = ["load_classifier"]


def load_classifier(
    path_or_name: str | Path, *, name: str | None = None, classes: Sequence[str] | None = None, device: str = "cpu"
) -> Classifier:
    """The classifier of a ``.pt2`` file (can be attacked) or ``.onnx`` file (only judges, on the CPU), or ``"tiny"``.

    ``name`` is what reports call it (the file's name without its ending by default), ``classes`` names its logits.
    Raises ``ClassifierError`` for anything else, and for a file that does not keep the contract.
    """
    if path_or_name == "tiny":
        return _tiny(device)
    path = Path(path_or_name)
    if path.suffix not in {".pt2", ".onnx"}:
        raise ClassifierError(
            f"{str(path_or_name)!r} is no classifier that is known here: give 'tiny' (the one that is shipped), "
            "a .pt2 file (torch.export.save; can be attacked) or an .onnx file (only judges)."
        )
    if not path.is_file():
        raise ClassifierError(f"There is no classifier file {str(path)!r}; check the path, or give 'tiny'.")
    if path.suffix == ".onnx":
        return load_onnx(path, name=name, classes=classes)
    return load_exported(path, name=name, classes=classes, device=device)


def _tiny(device: str) -> NetworkClassifier:
    return NetworkClassifier("tiny", load_tiny().to(device).eval(), IMAGE_SIZE, len(CLASSES), tuple(CLASSES), device)
