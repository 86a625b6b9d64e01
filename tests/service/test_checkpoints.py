"""Checkpoints on the disk: what is damaged is noticed, and the one before is used."""

import random
from pathlib import Path

import pytest
import torch

from tests.attack_runs import same
from trompe_server.attack import AttackState
from trompe_server.job.files import JobFiles
from trompe_server.job.protocol import DamagedFileError
from trompe_server.storage.folders import LocalArtifacts


def state(step: int) -> AttackState:
    values = torch.arange(192, dtype=torch.float32).reshape(8, 8, 3) * step
    return AttackState(step, {"paint.png": values}, {"velocity": values + 1})


@pytest.fixture
def files(tmp_path: Path) -> JobFiles:
    return JobFiles(LocalArtifacts(tmp_path), chunks=4)


def test_a_checkpoint_outlives_the_writing_of_the_next(files: JobFiles) -> None:
    files.save_state(1, state(5))
    files.save_state(2, state(10))
    assert same(files.load_state(1, step=5), state(5))
    assert same(files.load_state(2, step=10), state(10))


def test_a_checkpoint_whose_place_a_later_one_has_taken_is_not_used(files: JobFiles) -> None:
    files.save_state(1, state(5))
    files.save_state(3, state(15))
    with pytest.raises(DamagedFileError, match="of step 15 instead of 5"):
        files.load_state(1, step=5)


def test_a_missing_checkpoint_is_a_damaged_one(files: JobFiles) -> None:
    with pytest.raises(DamagedFileError, match="state-1"):
        files.load_state(1, step=5)
    assert not files.has_calibration(0)
    with pytest.raises(DamagedFileError, match="views_before"):
        files.load("views_before")


def test_any_changed_byte_is_noticed_and_any_cut(files: JobFiles) -> None:
    files.save_state(1, state(5))
    whole = files.artifacts.read("state-1.npz")
    dice = random.Random(0)
    for place in [*range(200), *(dice.randrange(len(whole)) for _ in range(400))]:
        damaged = bytearray(whole)
        damaged[place] ^= 1 << dice.randrange(8)
        files.artifacts.write("state-1.npz", bytes(damaged))
        with pytest.raises(DamagedFileError, match="checksum"):
            files.load_state(1, step=5)
    for length in range(0, len(whole), 97):
        files.artifacts.write("state-1.npz", whole[:length])
        with pytest.raises(DamagedFileError):
            files.load_state(1, step=5)
