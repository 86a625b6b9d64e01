"""Attack state and arrays as files."""

from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from tests.attack_runs import same
from trompe_server.attack import AttackState, load_state, save_state
from trompe_server.storage.arrays import pack_arrays, unpack_arrays


@given(st.integers(0, 2**31), st.sampled_from(["a.png", "Straße 7.png", "x.npy", "step", "file"]))
@settings(max_examples=20)
def test_a_state_comes_back_exactly(seed: int, name: str) -> None:
    generator = torch.Generator().manual_seed(seed)
    deltas = {name: torch.randn(4, 5, 3, generator=generator), "other.png": torch.zeros(1, 1, 3)}
    memory = {name: torch.randn(20, 3, generator=generator), "count": torch.tensor(seed)}
    state = AttackState(seed, deltas, memory, {name: torch.randn(4, 5, 3, generator=generator)})
    again = load_state(save_state(state))
    assert list(again.deltas) == list(state.deltas)
    assert same(again, state)
    assert same(AttackState(seed, again.momentum), AttackState(seed, state.momentum))


def test_arrays_come_back_exactly() -> None:
    arrays: dict[str, NDArray[Any]] = {
        "images": np.arange(24, dtype=np.uint8).reshape(2, 3, 4),
        "half": np.array([0.1, np.nan], np.float16),
        "none": np.zeros((0, 3)),
    }
    again = unpack_arrays(pack_arrays(arrays))
    assert list(again) == list(arrays)
    for name, array in arrays.items():
        assert again[name].dtype == array.dtype
        np.testing.assert_array_equal(again[name], array)


PACKED = pack_arrays({"a": np.arange(100), "b": np.zeros(3)})


@pytest.mark.parametrize(
    "data", [b"", b"no archive", PACKED[: len(PACKED) // 2], PACKED[:60] + b"\xff" * 40 + PACKED[100:]], ids=len
)
def test_damaged_bytes_are_an_error_to_catch(data: bytes) -> None:
    for read in (unpack_arrays, load_state):
        with pytest.raises((ValueError, OSError)):
            read(data)


def test_other_arrays_are_not_a_state() -> None:
    with pytest.raises(ValueError, match="step"):
        load_state(PACKED)
