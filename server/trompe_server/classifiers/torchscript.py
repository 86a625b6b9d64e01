"""Classifiers from TorchScript files (``.pt``, ``.torchscript``), which ``torch.jit.save`` writes. They give gradients.

A TorchScript archive is read without Python's pickle: its objects are rebuilt by an unpickler that knows tensors and
TorchScript's own classes only, and its code is TorchScript, which reaches torch's operators and nothing else. What is
left of what a stranger's file could do, and what is asked of it here before it is loaded or run:

- ``__setstate__`` runs while the file is read, and so does that of classes written in C++: no file with either;
- among the operators are some that write or map files (``aten::save``, ``aten::from_file``), Python calls and remote
  calls: only the other ATen operators and plain control flow, looked for in the graph after it was parsed, every call
  inlined, so that no spelling in the source can hide one.

This closes the ways found; it is no sandbox. Read strangers' files in a process of their own, as ``inspect`` does.
A file that ``torch.save`` wrote (also ``.pt``) is a pickle of Python code and never read.

The contract is that of ``.pt2``. TorchScript does not tell the size of the images: it is taken from the inputs that
``torch.jit.trace`` keeps, from an extra file ``image_size`` in the archive, or from the caller.
"""

import io
import re
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Final

import torch

from trompe_server.classifiers.contract import broken, check_contract, sample_images
from trompe_server.classifiers.network import NetworkClassifier
from trompe_server.classifiers.protocol import check_classes
from trompe_shared.errors import ClassifierError

__all__ = ["load_torchscript"]

FILE_OPERATORS: Final = frozenset({"aten::from_file", "aten::save"})
CONTROL: Final = frozenset(
    f"prim::{name}"
    for name in (
        *("Constant", "GetAttr", "SetAttr", "If", "Loop", "RaiseException", "Uninitialized", "Print"),
        *("ListConstruct", "ListUnpack", "TupleConstruct", "TupleUnpack", "TupleIndex", "DictConstruct"),
        *("NumToTensor", "dtype", "device", "is_cuda", "layout", "requires_grad", "unchecked_cast", "min", "max"),
    )
)
SIZE_FILE: Final = "image_size"
SIZE_HELP: Final = (
    "write it into the file, torch.jit.save(network, path, _extra_files={'image_size': '224 224'}), trace the network "
    "on an image of that size, or pass image_size=(H, W)"
)


def load_torchscript(
    path: Path,
    *,
    name: str | None = None,
    classes: Sequence[str] | None = None,
    image_size: tuple[int, int] | None = None,
    device: str = "cpu",
) -> NetworkClassifier:
    """A TorchScript file as a white-box classifier, its batch norm folded; ``image_size`` (H, W) where it has none.

    Raises ``ClassifierError`` when the file is something else, is not safe, or does not keep the contract.
    """
    data = path.read_bytes()
    traced = _check_archive(data, path.name)
    module, noted = _read(data, path.name, traced=traced, device=device)
    _check_graph(module.inlined_graph, path.name)
    size = image_size or _noted_size(noted, path.name) or _traced_size(module, path.name)
    with _without_warnings():
        network = torch.jit.freeze(module.eval())
        sample = sample_images(size).to(device)
        n_classes = check_contract(network, sample, path.name)
    names = check_classes(classes, n_classes, path.name)
    return NetworkClassifier(name or path.stem, network, size, n_classes, names, device)


def _without_warnings() -> "warnings.catch_warnings[None]":
    """TorchScript is deprecated in favour of ``torch.export``; the networks that exist in it are not ours to change."""
    return warnings.catch_warnings(action="ignore", category=DeprecationWarning)


def _check_archive(data: bytes, file: str) -> bool:
    """Whether the archive holds the inputs of a trace. Raises ``ClassifierError`` when it is no TorchScript or runs
    code while it is read."""
    try:
        reader = torch._C.PyTorchFileReader(io.BytesIO(data))
        members = {member: reader.get_record(member) for member in reader.get_all_records()}
    except RuntimeError as error:
        raise _unreadable(file, str(error)) from error
    if "constants.pkl" not in members:
        raise _unreadable(file, "a pickle of Python objects, which could run code of its own, or weights alone")
    for member, content in members.items():
        for word in (b"__setstate__", b"torch.classes"):
            if word in content and member.endswith((".py", ".pkl")):
                raise _unsafe(file, f"{word.decode()} in {member!r}")
    return "traced_inputs.pkl" in members


def _unreadable(file: str, why: str) -> ClassifierError:
    return ClassifierError(
        f"{file!r} cannot be read as TorchScript ({why[:300]}); expected a file that torch.jit.save wrote. "
        "Export the network with torch.export.save (.pt2), or trace it and save it with torch.jit.save."
    )


def _unsafe(file: str, what: str) -> ClassifierError:
    return ClassifierError(
        f"{file!r} is refused: it holds {what}, which could run code of its own or touch files. Expected a plain "
        "network of ATen operators; trace it again with torch.jit.trace, or export it with torch.export."
    )


def _read(data: bytes, file: str, *, traced: bool, device: str) -> tuple[Any, str]:
    """(module, text of the extra file with the size). Raises ``ClassifierError``."""
    extra = {SIZE_FILE: ""}
    try:
        with _without_warnings():
            module = torch.jit.load(  # type: ignore[no-untyped-call]
                io.BytesIO(data), device, extra, _restore_shapes=traced
            )
    except (RuntimeError, ValueError) as error:
        raise _unreadable(file, str(error)) from error
    noted: str | bytes = extra[SIZE_FILE]  # torch gives bytes, and leaves the text alone where there is no such file
    return module, noted.decode(errors="replace") if isinstance(noted, bytes) else noted


def _check_graph(graph: Any, file: str) -> None:
    """Raise ``ClassifierError`` when the graph of ``forward`` calls anything but plain operators."""
    for kind in _kinds(graph):
        if kind in FILE_OPERATORS or not (kind.startswith("aten::") or kind in CONTROL):
            raise _unsafe(file, f"the operator {kind}")


def _kinds(block: Any) -> Iterator[str]:
    for node in block.nodes():
        yield node.kind()
        for inner in node.blocks():
            yield from _kinds(inner)


def _noted_size(text: str, file: str) -> tuple[int, int] | None:
    """(H, W) of the extra file, ``None`` where there is none. Raises ``ClassifierError`` when it is no size."""
    if not text:
        return None
    match = re.fullmatch(r"\s*([1-9]\d{0,4})\s+([1-9]\d{0,4})\s*", text)
    if match is None:
        raise broken(file, f"its extra file {SIZE_FILE!r} is {text[:40]!r}, not height and width, such as '224 224'")
    return int(match[1]), int(match[2])


def _traced_size(module: Any, file: str) -> tuple[int, int]:
    """(H, W) of the image that the network was traced on. Raises ``ClassifierError``."""
    *_, image = module.graph.inputs()
    sizes = image.type().sizes() if image.type().kind() == "TensorType" else None
    if sizes is None or len(sizes) != 4:
        raise broken(file, f"it does not tell the size of its images; {SIZE_HELP}")
    return sizes[2], sizes[3]
