"""Classifiers from ``.onnx`` files, run by onnxruntime: scores only, no gradients."""

import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from trompe_server.classifiers.contract import SAME, sample_images
from trompe_server.classifiers.protocol import BATCH, Images, Logits, broken, predicted, refuse_probabilities
from trompe_shared.errors import ClassifierError

os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")  # else it records its use in the home folder and reports it
import onnxruntime

_WEIGHTS_APART: Final = re.compile("external data|GetFileLength", re.IGNORECASE)
"""onnxruntime's words, new and old, for a missing file of weights."""


@dataclass(frozen=True)
class OnnxClassifier:
    """An onnxruntime session; ``fixed_batch``: its only batch size, if it has one."""

    name: str
    session: Any
    image_size: tuple[int, int]
    n_classes: int
    fixed_batch: int | None
    classes: tuple[str, ...] | None = None

    def predict(self, images: Images) -> Logits:
        """Logits (N, n_classes), all finite, of uint8 images (N, H, W, 3) of any size."""
        return predicted(self.scores, images, self.image_size, self.n_classes, batch=self.fixed_batch or BATCH)

    def scores(self, images: Float[Tensor, "n 3 H W"]) -> Float[Tensor, "n classes"]:
        """Logits of sRGB images in [0, 1] of size ``image_size``, on the images' device; no gradient."""
        chunks = [torch.zeros((0, self.n_classes))]
        for batch in torch.split(images.detach().cpu(), self.fixed_batch or BATCH):
            chunks.append(torch.from_numpy(_run(self.session, batch.contiguous().numpy(), self.fixed_batch)))
        return torch.cat(chunks).to(images.device)


def load_onnx(path: Path, device: str = "cpu") -> OnnxClassifier:
    """Load an ``.onnx`` file on ``"cpu"``, ``"cuda"`` or ``"cuda:N"``, on the CPU where this onnxruntime has no other.

    Raises ``ClassifierError`` if it breaks the contract.
    """
    session = _session(path, device)
    fixed_batch, size = _input(session, path.name)
    images = sample_images(size).numpy()
    try:
        logits = _run(session, images[1:], fixed_batch)
    except Exception as error:
        raise broken(path.name, f"it does not run on one image ({str(error)[:300]})") from error
    if logits.ndim != 2 or logits.dtype != np.float32 or len(logits) != 1:
        raise broken(path.name, f"its output for one image is {logits.dtype} {logits.shape}")
    if logits.shape[1] < 2:
        raise broken(path.name, "it gives one score: export one of each class, (-z, z) of a binary network")
    if not np.isfinite(logits).all():
        raise broken(path.name, "its output is not finite")
    if not _alike(_run(session, images[1:], fixed_batch), logits):
        raise broken(path.name, "its logits of an image depend on chance")
    refuse_probabilities(logits, path.name)
    if fixed_batch != 1 and not _takes_batches(session, images, logits, fixed_batch):
        if fixed_batch:
            raise broken(path.name, f"its logits of an image depend on the others of its batch of {fixed_batch}")
        fixed_batch = 1
    return OnnxClassifier(path.stem, session, size, logits.shape[1], fixed_batch)


def _providers(device: str) -> list[str | tuple[str, dict[str, str]]]:
    """onnxruntime's providers for the device, where this build has them (onnxruntime-gpu), and the CPU."""
    kind, _, number = device.partition(":")
    provider = f"{kind.upper()}ExecutionProvider"
    if kind == "cpu" or provider not in onnxruntime.get_available_providers():
        return ["CPUExecutionProvider"]
    return [(provider, {"device_id": number or "0"}), "CPUExecutionProvider"]


def _session(path: Path, device: str) -> Any:
    providers = _providers(device)
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = torch.get_num_threads()
    options.log_severity_level = 4  # errors are raised, too
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    try:
        return onnxruntime.InferenceSession(str(path), options, providers=providers)
    except Exception as error:
        if _WEIGHTS_APART.search(str(error)):
            raise ClassifierError(
                f"{path.name!r} keeps its weights in another file, which is not here. Write one file: "
                "torch.onnx.export(..., external_data=False), or onnx.save(onnx.load(FILE), NEW) beside the weights."
            ) from error
        said = str(error).replace(str(path), path.name)[-300:]  # its end tells the reason
        raise broken(path.name, f"onnxruntime cannot read it ({said})") from error


def _input(session: Any, file: str) -> tuple[int | None, tuple[int, int]]:
    """The batch size, if fixed, and (H, W) of the only input. Raises ``ClassifierError``."""
    inputs, outputs = session.get_inputs(), session.get_outputs()
    if len(inputs) != 1 or len(outputs) != 1:
        raise broken(file, f"it has {_listed('input', inputs)} and {_listed('output', outputs)}, expected one of each")
    if not outputs[0].type.startswith("tensor("):
        raise broken(file, f"its output is {outputs[0].type} (scikit-learn's ZipMap): export the raw scores alone")
    shape, kind = inputs[0].shape, inputs[0].type
    if len(shape) == 4 and shape[3] == 3 and shape[1] != 3:
        raise broken(file, f"its input {shape} has channels last: put a Transpose before it")
    if len(shape) != 4 or (isinstance(shape[1], int) and shape[1] != 3) or kind != "tensor(float)":
        raise broken(file, f"its input is {kind} {shape}")
    batch, _, height, width = shape
    if not (isinstance(height, int) and isinstance(width, int)):
        raise broken(
            file, f"its input {shape} has no height and width: fix them with onnxruntime.tools.make_dynamic_shape_fixed"
        )
    return batch if isinstance(batch, int) else None, (height, width)


def _listed(kind: str, values: Sequence[Any]) -> str:
    """Number and names of inputs or outputs, for messages."""
    return f"{len(values)} {kind}s ({', '.join(value.name for value in values[:5])})"


def _takes_batches(session: Any, images: Logits, last: Logits, fixed_batch: int | None) -> bool:
    """Whether two images get the same logits together as alone; ``last``: those of the second one.

    Not from a graph with a reshape for one image or in training mode, nor if 8-bit activations are scaled by the range
    of the batch.
    """
    alone = np.concatenate([_run(session, images[:1], fixed_batch), last])
    try:
        together = _run(session, images, fixed_batch)
    except Exception:  # of onnxruntime, which has no common class of errors
        return False
    return _alike(together, alone)


def _alike(some: Logits, others: Logits) -> bool:
    return some.shape == others.shape and bool(np.abs(some - others).max() <= SAME * np.abs(others).max())


def _run(session: Any, images: Logits, fixed_batch: int | None) -> Logits:
    """Logits of images (n, 3, H, W); an incomplete fixed batch is padded with black images."""
    missing = (fixed_batch or len(images)) - len(images)
    padded = np.pad(images, ((0, missing), (0, 0), (0, 0), (0, 0)))
    logits: Logits = session.run(None, {session.get_inputs()[0].name: padded})[0]
    return logits[: len(images)]
