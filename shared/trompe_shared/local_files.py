"""Model files and classifiers on this machine, as a user names them: files, folders, and what lies beside them."""

import io
import json
import zipfile
from pathlib import Path
from typing import Final

from trompe_shared.errors import ClassifierError, ObjectError

CLASSIFIER_SUFFIXES: Final = (".pt2", ".onnx")
LOOKED_UP: Final = ("torchvision:", "timm:", "robustbench:", "hf:")
"""Prefixes of networks by name, whatever their suffix."""
SPLIT_SUFFIXES: Final = {".obj", ".gltf"}
"""Models with textures and materials in files beside them."""
MODEL_SUFFIXES: Final = {*SPLIT_SUFFIXES, ".glb", ".fbx", ".ply", ".stl"}
PICTURE_SUFFIXES: Final = {".png", ".jpg", ".jpeg", ".webp", ".bmp", ".tga", ".tif", ".tiff", ".gif"}
"""Of the formats of textures (``object3d.IMAGE_FORMATS``)."""


def model_file(path: Path) -> tuple[str, bytes | Path]:
    """(Name, content) of a zip, a model file (an .obj or .gltf with the files beside it), or a folder with one.

    The content is the path of a single file, or a zip's bytes. Raises ``ObjectError``.
    """
    if path.is_dir():
        return f"{path.resolve().name}.zip", _zip_folder(path)
    if not path.is_file():
        raise ObjectError(
            f"There is no file {str(path)!r}. Give a zip, a model file, a folder with one, or a stored object's name."
        )
    if path.suffix.lower() in SPLIT_SUFFIXES:
        return f"{path.stem}.zip", _zip_files([path, *_companions(path)])
    if path.suffix.lower() not in MODEL_SUFFIXES and not zipfile.is_zipfile(path):
        raise ObjectError(f"{str(path)!r} is not a zip archive. Give a zip, a model file, or a folder with one.")
    return path.name, path


def classes_beside(path: Path) -> list[str] | None:
    """Class names in a JSON file beside a classifier's; ``None`` without one. Raises ``ClassifierError``."""
    candidates = [f"{path.stem}.classes.json", "imagenet_classes.json", "classes.json"]
    file = next((file for name in candidates if (file := path.with_name(name)).is_file()), None)
    if file is None:
        return None
    try:
        names = json.loads(file.read_text("utf-8"))
    except ValueError as error:
        raise ClassifierError(f"The class names in {str(file)!r} are not JSON ({error}).") from error
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise ClassifierError(
            f"The class names in {str(file)!r} must be a JSON list of strings, in the order of the logits."
        )
    return names


def _zip_folder(folder: Path) -> bytes:
    files = [file for file in folder.iterdir() if file.is_file() and not file.name.startswith(".")]
    if not models_in(folder):
        raise ObjectError(f"The folder {str(folder)!r} holds no .obj, .gltf or other model file.")
    return _zip_files(files)


def models_in(folder: Path) -> list[Path]:
    """The model files in a folder."""
    return [file for file in folder.iterdir() if file.suffix.lower() in MODEL_SUFFIXES]


def _companions(mesh: Path) -> list[Path]:
    """Material files, buffers and pictures beside an .obj or .gltf file."""
    wanted = {".mtl", ".json", ".bin", *PICTURE_SUFFIXES}
    return [file for file in mesh.parent.iterdir() if file.is_file() and file.suffix.lower() in wanted]


def _zip_files(files: list[Path]) -> bytes:
    """A flat zip, sorted by name, with fixed time stamps: the same files give the same bytes."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for file in sorted(files, key=lambda file: file.name):
            info = zipfile.ZipInfo(file.name, (1980, 1, 1, 0, 0, 0))
            archive.writestr(info, file.read_bytes(), compress_type=zipfile.ZIP_DEFLATED, compresslevel=1)
    return buffer.getvalue()
