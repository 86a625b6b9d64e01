"""Model files and classifiers on this machine, as a user names them, and the files that a model names."""

import io
import itertools
import json
import os
import posixpath
import re
import unicodedata
import zipfile
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import Any, Final
from urllib.parse import unquote

from trompe_shared.errors import ClassifierError, ObjectError

CLASSIFIER_SUFFIXES: Final = (".pt2", ".onnx")
LOOKED_UP: Final = ("torchvision:", "timm:", "robustbench:", "hf:")
"""Prefixes of networks by name, whatever their suffix."""
SPLIT_SUFFIXES: Final = {".obj", ".gltf"}
"""Models with textures and materials in files beside them."""
PICTURED_SUFFIXES: Final = {".fbx", ".ply"}
"""Models that may have pictures in files beside them."""
MODEL_SUFFIXES: Final = {*SPLIT_SUFFIXES, *PICTURED_SUFFIXES, ".glb", ".stl"}
PICTURE_SUFFIXES: Final = {".png", ".jpg", ".jpeg", ".webp", ".bmp", ".tga", ".tif", ".tiff", ".gif"}
"""Of the formats of textures (``object3d.IMAGE_FORMATS``)."""
_BESIDE: Final = {*MODEL_SUFFIXES, *PICTURE_SUFFIXES, ".mtl", ".json", ".bin"}
"""Of the files of a model."""
_BELOW: Final = ("*/*", "*/*/*")
"""Patterns of files one and two folders below."""
MANY: Final = 10_000
"""Files that are looked at for a lost picture: a larger folder holds more than a model."""
_MTLLIB: Final = re.compile(r"mtllib(?<![^\r\n]mtllib)[ \t]+([^\r\n]+)")
"""The literal comes first: 50 times as fast as the check for the start of a line."""
_MAP: Final = re.compile(r"map_|(?:bump|norm|disp|decal|refl)$", re.IGNORECASE)
"""The first word of an MTL's line with a picture."""


def model_file(path: Path) -> tuple[str, bytes | Path]:
    """(Name, content) of a zip, a model file (with the files it names), or a folder with one.

    The content is the path of a single file, or a zip's bytes. Raises ``ObjectError``.
    """
    if path.is_dir():
        return f"{path.resolve().name}.zip", _zip_folder(path)
    if not path.is_file():
        raise ObjectError(
            f"There is no file {str(path)!r}. Give a zip, a model file, a folder with one, or a stored object's name."
        )
    if is_split(path):
        return f"{path.stem}.zip", _zip_files(path.parent, files_of(path))
    if path.suffix.lower() not in MODEL_SUFFIXES and not zipfile.is_zipfile(path):
        raise ObjectError(
            f"{str(path)!r} is not a zip archive and no model that is read. Give a zip, one of "
            f"{', '.join(sorted(MODEL_SUFFIXES))}, or a folder with one; other programs' files can be exported as glTF."
        )
    return path.name, path


def is_split(path: Path) -> bool:
    """Whether a model is sent with files beside it."""
    if path.suffix.lower() in PICTURED_SUFFIXES:
        return path.is_file() and len(files_of(path)) > 1
    return path.suffix.lower() in SPLIT_SUFFIXES


def classes_beside(path: Path) -> list[str] | None:
    """Class names in a JSON file beside a classifier's; ``None`` without one. Raises ``ClassifierError``."""
    candidates = [f"{path.stem}.classes.json", "imagenet_classes.json", "classes.json"]
    file = next((file for name in candidates if (file := path.with_name(name)).is_file()), None)
    if file is None:
        return None
    try:
        names = json.loads(file.read_text("utf-8-sig"))
    except ValueError as error:
        raise ClassifierError(
            f"The class names in {str(file)!r} are not JSON ({error}); expected a list of strings, in the order of the "
            "logits."
        ) from error
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise ClassifierError(
            f"The class names in {str(file)!r} must be a JSON list of strings, in the order of the logits."
        )
    return names


def _zip_folder(folder: Path) -> bytes:
    models = models_in(folder)
    if not models:
        raise ObjectError(f"The folder {str(folder)!r} holds no .obj, .gltf or other model file.")
    if models[0].parent != folder:
        below = (file.relative_to(folder) for file in folder.rglob("*") if file.suffix.lower() in _BESIDE)
        shown = [str(file) for file in below if not any(part.startswith(".") for part in file.parts)]
        return _zip_files(folder, [file for file in shown if _spelled(folder, file)])
    files = [file.name for file in folder.iterdir() if file.is_file() and not file.name.startswith(".")]
    split = [model for model in models if is_split(model)]
    return _zip_files(folder, [*files, *(name for model in split for name in files_of(model))])


def models_in(folder: Path) -> list[Path]:
    """The model files in a folder; if there is none, those one or two folders below."""
    patterns = ("*", *_BELOW)
    found = ([file for file in sorted(folder.glob(each)) if file.suffix.lower() in MODEL_SUFFIXES] for each in patterns)
    return next((files for files in found if files), [])


def files_of(mesh: Path) -> list[str]:
    """A model file and the files it names, also through its materials, as paths below its folder."""
    folder = mesh.parent
    if mesh.suffix.lower() in PICTURED_SUFFIXES:
        return [mesh.name, *_pictures_in(mesh)]
    if mesh.suffix.lower() == ".gltf":
        return [mesh.name, *_found(folder, _uris(_json(mesh)))]
    table = _found(folder, [f"{mesh.stem}_mat_def.json"])
    mtls = _found(folder, library_names(text_of(mesh.read_bytes())))
    if not mtls and not table:
        mtls = _found(folder, [file.name for file in folder.iterdir() if file.suffix.lower() == ".mtl"])
    maps = [name for file in table for name in _found(folder, _strings(_json(folder / file)))]
    maps += [name for mtl in mtls for name in _maps(folder, mtl)]
    return list(dict.fromkeys([mesh.name, *table, *mtls, *maps]))


def _pictures_in(mesh: Path) -> list[str]:
    """The pictures in the folder of an .fbx or .ply, or one level below, whose names occur in it."""
    content, folder = mesh.read_bytes().lower(), mesh.parent
    found = (file for pattern in ("*", "*/*") for file in sorted(folder.glob(pattern)))
    pictures = (file for file in found if file.suffix.lower() in PICTURE_SUFFIXES)
    occur = [str(file.relative_to(folder)) for file in pictures if re.search(_word(file.name), content)]
    return _found(folder, occur)


def _word(name: str) -> bytes:
    """Pattern of a file's name, ASCII letters in lower case, that is not the end of a longer name."""
    return rb"(?<![\w-])" + re.escape(name.encode().lower())


def _maps(folder: Path, mtl: str) -> Iterator[str]:
    """The pictures of an MTL. A name may contain blanks and follow options, so the longest that exists counts."""
    for words in map(str.split, re.split(r"[\r\n]+", text_of((folder / mtl).read_bytes()))):
        if words and _MAP.match(words[0]):
            names = [" ".join(words[k:]) for k in range(1, len(words))]
            yield from _found(folder, names, beside=posixpath.dirname(mtl))[:1]


def _found(folder: Path, names: Collection[str], *, beside: str = "") -> list[str]:
    """The files that ``names`` mean, by path below ``folder``.

    Relative to it or to ``beside``, else by last part, there or in the only folder below that has one.
    """
    found = []
    for name in (name.replace("\\", "/") for name in names):
        paths = [posixpath.join(base, each) for each in (name, posixpath.basename(name)) for base in (beside, "")]
        files = (_spelled(folder, posixpath.normpath(path)) for path in paths)
        file = next((file for file in files if file is not None), None) or _below(folder, posixpath.basename(name))
        found += [] if file is None else [file]
    return found


def _below(folder: Path, name: str) -> str | None:
    """The only file of a name one or two folders below ``folder``, in any capitals."""
    files = itertools.islice((file for each in _BELOW for file in folder.glob(each)), MANY)
    alike = [file for file in files if spelling(file.name) == spelling(name)]
    return _spelled(folder, str(alike[0].relative_to(folder))) if len(alike) == 1 else None


def _spelled(folder: Path, path: str) -> str | None:
    """A file at ``path`` below ``folder``, in any capitals; no link out of it."""
    here = ""
    for part in path.split("/"):
        found = named(part, os.listdir(folder / here)) if (folder / here).is_dir() else None
        if found is None:
            return None
        here = posixpath.join(here, found)
    inside = (folder / here).resolve().is_relative_to(folder.resolve())
    return here if inside and (folder / here).is_file() else None


def _json(file: Path) -> Any:
    """The file's JSON; ``None`` for a malformed one, which its reader will refuse."""
    try:
        return json.loads(file.read_bytes())
    except (ValueError, RecursionError):
        return None


def _uris(document: Any) -> list[str]:
    """The files that a glTF names."""
    tables = [document.get(kind) for kind in ("buffers", "images")] if isinstance(document, dict) else []
    entries = [entry for table in tables if isinstance(table, list) for entry in table if isinstance(entry, dict)]
    uris = [uri for entry in entries if isinstance(uri := entry.get("uri"), str)]
    return [unquote(uri) for uri in uris if not uri.startswith("data:")]


def _strings(table: Any) -> list[str]:
    """The file names in a material definition."""
    materials = table.values() if isinstance(table, dict) else ()
    return [name for maps in materials if isinstance(maps, dict) for name in maps.values() if isinstance(name, str)]


def text_of(data: bytes) -> str:
    """The text of an OBJ or MTL file."""
    return data.decode(encoding_of(data))


def encoding_of(data: bytes) -> str:
    """UTF-8 with or without byte order mark, else Latin-1, which loses no byte."""
    try:
        data.decode()
    except UnicodeDecodeError:
        return "latin-1"
    return "utf-8-sig" if data.startswith(b"\xef\xbb\xbf") else "utf-8"


def library_names(text: str) -> list[str]:
    """The names on the ``mtllib`` lines of an OBJ, several a line; a name may contain blanks."""
    names = []
    for line in _MTLLIB.findall(text):
        words: list[str] = []
        for word in line.split():
            words.append(word)
            if word.lower().endswith(".mtl"):
                names.append(" ".join(words))
                words = []
    return list(dict.fromkeys(names))


def libraries(text: str, files: Collection[str]) -> dict[str, str]:
    """The MTLs among ``files`` (names without folders) that an OBJ names, with their paths there, in that order.

    All MTLs if it names none of them.
    """
    beside = [name for name in files if name.lower().endswith(".mtl")]
    found: dict[str, str] = {}
    for written in library_names(text):
        name = base_name(written)
        if (file := named(name, beside)) is not None:
            found.setdefault(file, written.removesuffix(name) + file)
    return found or {name: name for name in beside}


def base_name(path: str) -> str:
    """The file name at the end of a path with slashes or backslashes."""
    return path.replace("\\", "/").rsplit("/", 1)[-1]


def named(name: str, files: Collection[str]) -> str | None:
    """The file ``name`` among ``files``, or the only one that differs in capitals or the coding of accents alone."""
    if name in files:
        return name
    alike = [file for file in files if spelling(file) == spelling(name)]
    return alike[0] if len(alike) == 1 else None


def spelling(name: str) -> str:
    """What a name has in common with its copies on systems that ignore capitals (Windows) or split accents (macOS)."""
    return unicodedata.normalize("NFC", name).casefold()


def pack_zip(files: Mapping[str, bytes]) -> bytes:
    """A deflated zip of ``files`` with fixed time stamps, in the order of the mapping."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name, data in files.items():
            stored = zipfile.ZIP_STORED if name.lower().endswith((".png", ".jpg")) else zipfile.ZIP_DEFLATED
            archive.writestr(zipfile.ZipInfo(name, (1980, 1, 1, 0, 0, 0)), data, compress_type=stored)
    return buffer.getvalue()


def _zip_files(folder: Path, files: list[str]) -> bytes:
    """A zip of files below ``folder``, sorted by path: the same files give the same bytes."""
    return pack_zip({name: (folder / name).read_bytes() for name in sorted(set(files))})
