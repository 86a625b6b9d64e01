"""Check a ``.pt2`` archive before torch reads it: torch alone runs code from the file.

The ways in torch 2.13 (``torch/export/pt2_archive/_package.py``, ``torch/_export/serde``), and the rule against each:

- Weights, constants and sample inputs may be pickles (``torch.load(weights_only=False)``, ``pickle.loads``; torch
  repeats a failed ``weights_only=True`` load without it). Allowed: raw tensors, and inputs ``weights_only`` can read.
- torch tries an unreadable archive as the format of torch 2.7, with pickles again. We call the reader below
  ``torch.export.load`` instead.
- An operator is any name under ``torch``, ``math`` or ``operator``, thus also ``torch.os.system``. Allowed: ATen
  operators that touch neither files nor the state of the process, and plain arithmetic.
- Symbolic sizes go through ``sympy.sympify``, which calls ``eval``. Allowed: integer arithmetic on symbols.
- Names end up in generated Python source. No quotes, brackets or line ends are allowed. Guards are code and are not
  compiled.
- Compiled libraries (AOTInductor) would be loaded. No such member is allowed.

This closes the known ways and is not a sandbox. ``inspect`` reads strangers' files in a process of its own.
"""

import io
import json
import pickle
import re
import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final

import torch
from torch.export import ExportedProgram
from torch.export.pt2_archive import PT2ArchiveReader
from torch.export.pt2_archive._package import load_pt2

from trompe_server.classifiers.protocol import refusing
from trompe_shared.errors import ClassifierError

MEMBER: Final = re.compile(
    r"models/model\.json|data/(weights|constants)/(weight_\d+|tensor_\d+|model_\w+_config\.json)"
    r"|data/sample_inputs/model\.pt|extra/.*|archive_format|archive_version|byteorder|\.data/\w+",
    re.ASCII,
)
TARGET: Final = re.compile(
    r"torch\.ops\.aten\.(?!(from_file|save|warn|_print|manual_seed|set_grad_enabled|_cufft\w*)\.)\w+\.\w+"
    r"|_operator\.(add|eq|floordiv|ge|getitem|gt|le|lt|mod|mul|ne|neg|sub|truediv)",
    re.ASCII,
)
NAME: Final = re.compile(r"[\w .,:/@+>-]*", re.ASCII)
SIZE: Final = re.compile(
    r"(Symbol\('[su]\d+'(, (positive|integer)=True)*\)"
    r"|(Integer|Add|Mul|Pow|FloorDiv|CleanDiv|Mod|Max|Min)(?=\()|s\d+|\d+|[-+*/(), ])+",
    re.ASCII,
)
TREE: Final = re.compile(r'builtins\.(tuple|list|dict)|null|\[("\w+"(, "\w+")*)?\]', re.ASCII)
PLAIN: Final[Mapping[str, re.Pattern[str]]] = {"tree": TREE, "expr_str": SIZE, "target": TARGET}
"""What strings of a kind may be; all others are names."""
DEVICE: Final = re.compile(rb'"type": "(?!cpu")\w+", "index": (\d+|null)')
"""A device other than the CPU, in an archive's JSON."""
PROSE: Final = frozenset({"metadata", "torch_version"})
"""Keys with text for people; torch never evaluates it."""


def read_program(path: Path) -> ExportedProgram:
    """Check and read the program in a ``.pt2`` file, onto the CPU. Raises ``ClassifierError``."""
    expected = f"; expected a file of torch.export.save from a version close to {torch.__version__}."
    with refusing(f"{path.name!r} cannot be read as an exported program", remedy=expected):
        data = path.read_bytes()
        if DEVICE.search(PT2ArchiveReader(io.BytesIO(data)).read_bytes("models/model.json")):
            data = _on_cpu(data)
        _check(PT2ArchiveReader(io.BytesIO(data)), path.name)
        return load_pt2(io.BytesIO(data)).exported_programs["model"]


def _on_cpu(data: bytes) -> bytes:
    """The archive of a program exported on another device, which torch may not have here, without its sample inputs."""
    moved = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(data)) as old, zipfile.ZipFile(moved, "w") as new:
        for name in old.namelist():
            content = b"" if name.endswith("sample_inputs/model.pt") else old.read(name)
            new.writestr(
                name, DEVICE.sub(b'"type": "cpu", "index": null', content) if name.endswith(".json") else content
            )
    return moved.getvalue()


def _check(archive: Any, file: str) -> None:
    """Raise ``ClassifierError`` if reading the archive could run code."""
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
        if kind != "guards_code" and not PLAIN.get(kind, NAME).fullmatch(text):
            raise _unsafe(file, f"the {kind} {text[:80]!r}")


def _check_sample_inputs(data: bytes, file: str) -> None:
    try:
        if data:
            torch.load(io.BytesIO(data), weights_only=True)
    except pickle.UnpicklingError as error:
        raise _unsafe(file, "sample inputs that are not tensors") from error


def _unsafe(file: str, what: str) -> ClassifierError:
    return ClassifierError(
        f"{file!r} is refused: it contains {what}, which could run code. Expected names of ASCII letters, digits and "
        "underscores, operators of ATen (no no_grad, autocast or cond in forward) and one tensor of logits; change "
        "that and export again with torch.export."
    )


def _texts(node: Any, key: str = "name") -> Iterator[tuple[str, str]]:
    """(kind, text) of every string in a program's JSON that torch may evaluate, including keys of mappings."""
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
