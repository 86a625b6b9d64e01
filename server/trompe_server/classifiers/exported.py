"""Classifiers from ``.pt2`` files, which ``torch.export.save`` writes. They give gradients: they can be attacked."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import torch
from torch import Tensor, nn
from torch.export import ExportedProgram
from torch.export.passes import move_to_device_pass

from trompe_server.classifiers.archive import read_program
from trompe_server.classifiers.fold import accelerate
from trompe_server.classifiers.network import NetworkClassifier
from trompe_server.classifiers.protocol import check_classes, refuse_probabilities
from trompe_shared.errors import ClassifierError

__all__ = ["load_exported"]

CONTRACT: Final = "input image float32 NCHW in [0, 1] with a dynamic batch, output logits (N, classes)"


def load_exported(
    path: Path, *, name: str | None = None, classes: Sequence[str] | None = None, device: str = "cpu"
) -> NetworkClassifier:
    """A ``.pt2`` file as a white-box classifier with frozen parameters, made faster where that changes nothing.

    The file is looked over before torch reads it (see ``archive``): ``torch.export.load`` unpickles, and worse.
    Raises ``ClassifierError`` when it does not keep the contract.
    """
    program = read_program(path)
    size = _image_size(program, path.name)
    if device != "cpu":
        program = move_to_device_pass(program, device)
    network = program.module(check_guards=False).requires_grad_(False)
    sample = _sample(size).to(device)
    n_classes = _check_contract(network, sample, path.name)
    names = check_classes(classes, n_classes, path.name)
    return NetworkClassifier(name or path.stem, accelerate(network, sample), size, n_classes, names, device)


def _broken(file: str, what: str) -> ClassifierError:
    return ClassifierError(f"{file!r}: {what}. Expected: {CONTRACT}; export it so, with the normalisation inside.")


def _image_size(program: ExportedProgram, file: str) -> tuple[int, int]:
    """(H, W) of the one image input. Raises ``ClassifierError``."""
    inputs = program.graph_signature.user_inputs
    if len(inputs) != 1:
        raise _broken(file, f"it takes {len(inputs)} inputs")
    (node,) = (n for n in program.graph.nodes if n.op == "placeholder" and n.name == inputs[0])
    value: Any = node.meta["val"]
    if not isinstance(value, Tensor) or value.ndim != 4 or value.shape[1] != 3 or value.dtype != torch.float32:
        raise _broken(file, f"its input is {_describe(value)}")
    batch, _, height, width = value.shape
    if not (isinstance(height, int) and isinstance(width, int)):
        raise _broken(file, "its input has no fixed height and width")
    if isinstance(batch, int):
        raise _broken(file, f"its batch is fixed to {batch}: pass dynamic_shapes=({{0: torch.export.Dim.DYNAMIC}},)")
    return height, width


def _describe(value: Any) -> str:
    return f"{value.dtype} {tuple(value.shape)}" if isinstance(value, Tensor) else f"a {type(value).__name__}"


def _sample(size: tuple[int, int]) -> Tensor:
    """Two images: plain grey and noise."""
    noise = torch.rand((1, 3, *size), generator=torch.Generator().manual_seed(0))
    return torch.cat([torch.full_like(noise, 0.5), noise])


def _check_contract(network: nn.Module, sample: Tensor, file: str) -> int:
    """Number of classes. Raises ``ClassifierError`` when the output is not finite, differentiable logits."""
    images = sample.clone().requires_grad_()
    try:
        logits = network(images)
    except RuntimeError as error:
        raise _broken(file, f"it does not run on two images ({str(error)[:300]})") from error
    if not isinstance(logits, Tensor) or logits.ndim != 2 or len(logits) != 2 or not logits.is_floating_point():
        raise _broken(file, f"its output for two images is {_describe(logits)}")
    if not torch.isfinite(logits).all():
        raise _broken(file, "its output is not finite")
    refuse_probabilities(logits.detach().cpu().numpy(), file)
    gradient = torch.autograd.grad(logits.max(), images, allow_unused=True)[0] if logits.requires_grad else None
    if gradient is None or not gradient.any():
        raise _broken(file, "its output has no gradient in the image")
    return logits.shape[1]
