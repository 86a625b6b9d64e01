"""White-box classifiers from ``.pt2`` files of ``torch.export.save``."""

from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.export import ExportedProgram
from torch.export.passes import move_to_device_pass

from trompe_server.classifiers.archive import read_program
from trompe_server.classifiers.contract import broken, check_contract, describe_value, sample_images
from trompe_server.classifiers.fold import accelerate
from trompe_server.classifiers.network import NetworkClassifier
from trompe_server.classifiers.protocol import AT_ONCE, BATCH


def load_exported(path: Path, device: str) -> NetworkClassifier:
    """Load a ``.pt2`` file as a white-box classifier with frozen parameters, accelerated if that changes nothing.

    The file is checked before torch reads it, because ``torch.export.load`` runs code from the file (see ``archive``).
    Raises ``ClassifierError`` if it breaks the contract.
    """
    program = read_program(path)
    size = _image_size(program, path.name, at_once=BATCH if device == "cpu" else AT_ONCE)
    if device != "cpu":
        program = move_to_device_pass(program, device)
    network = program.module(check_guards=False).requires_grad_(False)
    sample = sample_images(size).to(device)
    n_classes = check_contract(network, sample, path.name)
    return NetworkClassifier(path.stem, accelerate(network, sample), size, n_classes, device=device)


def _image_size(program: ExportedProgram, file: str, *, at_once: int) -> tuple[int, int]:
    """(H, W) of the one image input, ``at_once`` images a batch. Raises ``ClassifierError``."""
    inputs = program.graph_signature.user_inputs
    if len(inputs) != 1:
        raise broken(file, f"it takes {len(inputs)} inputs")
    if program.call_spec.in_spec.unflatten(inputs)[1]:
        raise broken(
            file, f"it takes its image as the keyword {inputs[0]!r}: export it with (images,) as its arguments"
        )
    (node,) = (n for n in program.graph.nodes if n.op == "placeholder" and n.name == inputs[0])
    value: Any = node.meta["val"]
    if not isinstance(value, Tensor) or value.ndim != 4 or value.shape[1] != 3 or value.dtype != torch.float32:
        raise broken(file, f"its input is {describe_value(value)}")
    batch, _, height, width = value.shape
    if not (isinstance(height, int) and isinstance(width, int)):
        raise broken(file, "its input has no fixed height and width")
    if isinstance(batch, int):
        raise broken(file, f"its batch is fixed to {batch}: pass dynamic_shapes=({{0: torch.export.Dim.DYNAMIC}},)")
    limits = program.range_constraints.get(batch.node.expr)
    if limits is not None and limits.upper < at_once:
        raise broken(file, f"its batch is limited to {limits.upper}: pass torch.export.Dim.DYNAMIC without a maximum")
    return height, width
