"""Calibrations as files: one for each job, and one for all later jobs that would ask the target the same questions."""

import hashlib
import json
from collections.abc import Sequence
from dataclasses import asdict

import numpy as np

from trompe_server.array_files import pack_arrays, unpack_arrays
from trompe_server.surrogate import SamplingModel
from trompe_server.surrogate.calibration import Calibration
from trompe_server.surrogate.fidelity import Fidelity
from trompe_shared.geometry import View
from trompe_shared.object3d import Object3D

__all__ = ["calibration_key", "pack_calibration", "unpack_calibration"]

VERSION = 3
"""Another for each way of calibrating that can find something else from the same answers. 1 knew no anisotropy and no
shift, 2 overlooked what changes where the surrogate sees no object."""


def calibration_key(obj: Object3D, views: Sequence[View], clean: np.ndarray, *, wanted: str, seed: int) -> str:
    """Name of the calibration that these would give: equal for equal objects, views and answers of the target.

    ``clean``, the target's images of the unpainted object, stand for the renderer: one that has changed shows it there.
    """
    digest = hashlib.sha256(json.dumps([VERSION, wanted, seed, [asdict(view) for view in views]]).encode())
    for name in sorted(obj.files):
        digest.update(name.encode() + b"\0" + hashlib.sha256(obj.files[name]).digest())
    digest.update(repr(clean.shape).encode() + np.ascontiguousarray(clean).tobytes())
    return digest.hexdigest()


def pack_calibration(calibration: Calibration) -> bytes:
    """A calibration as the bytes of an .npz file; exact."""
    words = {name: value for name, value in vars(calibration).items() if name != "probes"}
    words |= {"sampling": asdict(calibration.sampling), "fidelity": asdict(calibration.fidelity)}
    text = np.frombuffer(json.dumps(words).encode(), np.uint8)
    return pack_arrays({"probes": calibration.probes, "words": text})


def unpack_calibration(data: bytes) -> Calibration:
    """What ``pack_calibration`` packed. Raises ``ValueError`` or ``OSError`` where the bytes are damaged."""
    arrays = unpack_arrays(data)
    try:
        words = json.loads(arrays["words"].tobytes())
        sampling = SamplingModel(**words["sampling"])
        words["sampling"] = sampling.but(shift=tuple(sampling.shift))
        words["fidelity"] = Fidelity(**{name: tuple(values) for name, values in words["fidelity"].items()})
        words["greys"] = tuple(words["greys"])
        return Calibration(**words, probes=arrays["probes"])
    except (KeyError, TypeError) as error:
        raise ValueError(f"These arrays are no calibration ({error}).") from error
