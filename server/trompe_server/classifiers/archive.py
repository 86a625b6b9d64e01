"""Look over a ``.pt2`` archive before torch reads it: reading one is not safe by itself.

What torch's source does with an archive (2.13, ``torch/export/pt2_archive/_package.py``, ``torch/_export/serde``), each
a way for a file to run code of its own, and what is asked here of an archive before it is handed on:

- weights, constants and sample inputs may be pickles (``torch.load(weights_only=False)``, ``pickle.loads``; a load
  with ``weights_only=True`` that fails is tried again without): only raw tensors, and inputs ``weights_only`` reads;
- an archive torch cannot read is tried as the format of torch 2.7, pickles again: ``torch.export.load`` is not called,
  the reader under it is;
- an operator is any name under ``torch``, ``math`` or ``operator``, so ``torch.os.system`` too: only ATen operators
  that touch no file, and plain arithmetic;
- symbolic sizes go through ``sympy.sympify``, that is ``eval``: only integer arithmetic on symbols;
- names end up in generated Python source: no quotes, brackets or line ends in any; guards are code: not compiled;
- compiled libraries (AOTInductor) would be loaded: no such member.

This closes the ways found; it is no sandbox. Read strangers' files in a process of their own, as ``inspect`` does.
"""

import io
import json
import pickle
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import torch
from torch.export import ExportedProgram
from torch.export.pt2_archive import PT2ArchiveReader
from torch.export.pt2_archive._package import load_pt2

from trompe_shared.errors import ClassifierError

__all__ = ["read_program"]

MEMBER: Final = re.compile(
    r"models/model\.json|data/(weights|constants)/(weight_\d+|tensor_\d+|model_\w+_config\.json)"
    r"|data/sample_inputs/model\.pt|extra/.*|archive_format|archive_version|byteorder|\.data/\w+",
    re.ASCII,
)
ATEN: Final = re.compile(r"torch\.ops\.aten\.(?!from_file\b)\w+\.\w+", re.ASCII)
ARITHMETIC: Final = frozenset(
    f"_operator.{name}"
    for name in (
        "add",
        "eq",
        "floordiv",
        "ge",
        "getitem",
        "gt",
        "le",
        "lt",
        "mod",
        "mul",
        "ne",
        "neg",
        "sub",
        "truediv",
    )
)
NAME: Final = re.compile(r"[\w .,:@+>-]*", re.ASCII)
SIZE: Final = re.compile(
    r"(Symbol\('[su]\d+'(, (positive|integer)=True)*\)"
    r"|(Integer|Add|Mul|Pow|FloorDiv|CleanDiv|Mod|Max|Min)(?=\()|s\d+|\d+|[-+*/(), ])+",
    re.ASCII,
)
TREE: Final = re.compile(r'builtins\.(tuple|list|dict)|null|\[("\w+"(, "\w+")*)?\]', re.ASCII)
PROSE: Final = frozenset({"metadata", "torch_version"})
"""Keys whose text is kept for people and never evaluated."""


def read_program(path: Path) -> ExportedProgram:
    """The program saved in a ``.pt2`` file, after a look at it. Raises ``ClassifierError``."""
    try:
        data = path.read_bytes()
        _check(PT2ArchiveReader(io.BytesIO(data)), path.name)
        return load_pt2(io.BytesIO(data)).exported_programs["model"]
    except ClassifierError:
        raise
    except Exception as error:
        raise ClassifierError(
            f"{path.name!r} cannot be read as an exported program ({type(error).__name__}: {str(error)[:300]}); "
            f"expected a file that torch.export.save wrote, by a version near this one ({torch.__version__})."
        ) from error


def _check(archive: Any, file: str) -> None:
    """Raise ``ClassifierError`` when the archive holds anything that could run code while it is read."""
    for member in archive.get_file_names():
        if not MEMBER.fullmatch(member):
            raise _unsafe(file, f"the member {member!r}")
    for kind in ("weights", "constants"):
        config = json.loads(archive.read_string(f"data/{kind}/model_{kind}_config.json"))["config"]
        for payload in config.values():
            if payload["use_pickle"] or not re.fullmatch(r"(weight|tensor)_\d+", payload["path_name"], re.ASCII):
                raise _unsafe(file, f"pickled {kind}")
    _check_sample_inputs(archive.read_bytes("data/sample_inputs/model.pt"), file)
    for kind, text in _texts(json.loads(archive.read_bytes("models/model.json"))):
        if not _is_plain(kind, text):
            raise _unsafe(file, f"the {kind} {text[:80]!r}")


def _check_sample_inputs(data: bytes, file: str) -> None:
    try:
        if data:
            torch.load(io.BytesIO(data), weights_only=True)
    except pickle.UnpicklingError as error:
        raise _unsafe(file, "sample inputs that are not tensors") from error


def _unsafe(file: str, what: str) -> ClassifierError:
    return ClassifierError(
        f"{file!r} is refused: it holds {what}, which could run code of its own. Expected raw float weights and ATen "
        "operators only; export the plain network again with torch.export."
    )


def _texts(node: Any, key: str = "name") -> Iterator[tuple[str, str]]:
    """(kind, text) of every string in a program's JSON that may be evaluated, keys of mappings included."""
    if isinstance(node, str):
        yield key, node
    elif isinstance(node, list):
        for item in node:
            yield from _texts(item, key)
    elif isinstance(node, dict):
        for name, value in node.items():
            yield "name", name
            if name in {"in_spec", "out_spec"} and value:
                yield from _texts(json.loads(value), "tree")
            elif name not in PROSE:
                yield from _texts(value, "tree" if key == "tree" else name)


def _is_plain(kind: str, text: str) -> bool:
    if kind == "tree":
        return TREE.fullmatch(text) is not None
    if kind == "expr_str":
        return SIZE.fullmatch(text) is not None
    if kind == "target":
        return text in ARITHMETIC or ATEN.fullmatch(text) is not None
    return kind == "guards_code" or NAME.fullmatch(text) is not None
