"""Calibrations as files: what was found out is read as it was written, also by a later version."""

import json
from dataclasses import asdict

import numpy as np
import pytest

from trompe_server.array_files import pack_arrays
from trompe_server.calibration_files import pack_calibration, unpack_calibration
from trompe_server.surrogate import SamplingModel
from trompe_server.surrogate.calibration import Calibration
from trompe_server.surrogate.fidelity import Fidelity

SAMPLING = SamplingModel(filtered="linear", bias=-0.25, anisotropy=16, elongated="ellipse", shift=(0.25, -0.125))
PROBES = np.random.default_rng(0).integers(0, 256, (2, 1, 4, 4, 3), dtype=np.uint8)
FOUND = Calibration("calibrated", "asked for", SAMPLING, (0, 128), PROBES, Fidelity((0.1,), (0.9,), (1.0,), (0.8,)), 7)


def test_a_calibration_is_read_as_it_was_written() -> None:
    read = unpack_calibration(pack_calibration(FOUND))
    assert (read.probes == PROBES).all()
    assert {**vars(read), "probes": None} == {**vars(FOUND), "probes": None}
    assert hash(read.sampling) == hash(SAMPLING)


def test_one_of_before_there_was_anisotropy_is_read_as_having_none() -> None:
    words = {name: value for name, value in vars(FOUND).items() if name != "probes"}
    older = {key: value for key, value in asdict(SAMPLING).items() if key not in {"anisotropy", "elongated", "shift"}}
    words |= {"sampling": older, "fidelity": asdict(FOUND.fidelity)}
    text = np.frombuffer(json.dumps(words).encode(), np.uint8)
    read = unpack_calibration(pack_arrays({"probes": PROBES, "words": text}))
    assert read.sampling == SAMPLING.but(anisotropy=1, elongated="probes", shift=(0.0, 0.0))


def test_bytes_that_are_no_calibration_are_refused() -> None:
    with pytest.raises(ValueError, match="no calibration"):
        unpack_calibration(pack_arrays({"probes": PROBES}))
