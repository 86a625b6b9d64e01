"""Calibrations as files: one for each job, and one shared by later jobs with the same probes."""

import hashlib
import json
from collections.abc import Sequence
from dataclasses import asdict

import numpy as np

from trompe_server.storage.arrays import pack_arrays, unpack_arrays
from trompe_server.surrogate import SamplingModel
from trompe_server.surrogate.calibration import Calibration
from trompe_server.surrogate.fidelity import Fidelity
from trompe_server.surrogate.tone import ToneMap
from trompe_shared.engine import EngineInfo
from trompe_shared.geometry import View
from trompe_shared.object3d import Object3D

VERSION = 8
"""To be raised whenever calibration can give another result from the same images."""


def calibration_key(
    obj: Object3D, views: Sequence[View], clean: np.ndarray, *, engine: EngineInfo, wanted: str, seed: int
) -> str:
    """Key of a calibration: equal for equal engines, objects, views and target images.

    clean: the target's images of the unpainted object.
    """
    asked = [VERSION, wanted, seed, engine.to_text(), [asdict(view) for view in views]]
    digest = hashlib.sha256(json.dumps(asked).encode())
    for name in sorted(obj.files):
        digest.update(name.encode() + b"\0" + hashlib.sha256(obj.files[name]).digest())
    digest.update(repr(clean.shape).encode() + np.ascontiguousarray(clean).tobytes())
    return digest.hexdigest()


def pack_calibration(calibration: Calibration) -> bytes:
    """A calibration as the bytes of an .npz file, without loss."""
    words = {name: value for name, value in vars(calibration).items() if name not in {"probes", "tone"}}
    words |= {"sampling": asdict(calibration.sampling), "fidelity": asdict(calibration.fidelity)}
    text = np.frombuffer(json.dumps(words).encode(), np.uint8)
    tone = {} if calibration.tone is None else calibration.tone.arrays()
    return pack_arrays({"probes": calibration.probes, "words": text} | tone)


def unpack_calibration(data: bytes) -> Calibration:
    """Inverse of ``pack_calibration``. Raises ``ValueError`` or ``OSError`` for damaged bytes."""
    arrays = unpack_arrays(data)
    try:
        words = json.loads(arrays["words"].tobytes())
        sampling = SamplingModel(**words["sampling"])
        words["sampling"] = sampling.but(shift=tuple(sampling.shift), kernel=tuple(sampling.kernel))
        words["fidelity"] = Fidelity(**{name: tuple(values) for name, values in words["fidelity"].items()})
        words["greys"] = tuple(words["greys"])
        tone = ToneMap.of(arrays) if "curves" in arrays else None
        return Calibration(**words, probes=arrays["probes"], tone=tone)
    except (KeyError, TypeError) as error:
        raise ValueError(f"These arrays are not a calibration ({error}).") from error
