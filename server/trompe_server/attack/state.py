"""State of an attack between two steps, in memory and as a file, for resuming."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final

import numpy as np
import torch
from torch import Tensor

from trompe_server.attack.objective import Textures
from trompe_server.storage.arrays import pack_arrays, unpack_arrays

DELTA, MEMORY, MOMENTUM = "delta:", "memory:", "momentum:"
"""Prefixes of array names in the file."""

STEP: Final = "step"


@dataclass(frozen=True)
class AttackState:
    """Input of the next step.

    deltas: change of each texture after ``step`` steps, in sRGB units of [0, 1], or of the means of its blocks of
    texels (``surrogate.blocks``), which the first step chooses. memory: tensors of the search by name. momentum:
    accumulated gradients as ``deltas``, zero for fixed texels; empty if the optimiser has none.
    """

    step: int
    deltas: Textures
    memory: Mapping[str, Tensor] = field(default_factory=dict)
    momentum: Textures = field(default_factory=dict)

    def to(self, device: torch.device) -> "AttackState":
        """The same state on a device; a loaded state is on the CPU."""
        tables = (self.deltas, self.memory, self.momentum)
        return AttackState(self.step, *({key: value.to(device) for key, value in each.items()} for each in tables))


def start(textures: Textures) -> AttackState:
    """The state of unpainted textures."""
    return AttackState(0, {name: torch.zeros_like(texture) for name, texture in textures.items()})


def save_state(state: AttackState) -> bytes:
    """A state as an .npz file; exact."""
    tables = {DELTA: state.deltas, MEMORY: state.memory, MOMENTUM: state.momentum}
    arrays = {prefix + name: table[name].cpu().numpy() for prefix, table in tables.items() for name in table}
    return pack_arrays({STEP: np.array(state.step)} | arrays, compressed=False)


def load_state(data: bytes) -> AttackState:
    """The state in ``save_state``'s bytes. Raises ``ValueError`` or ``OSError`` for damaged ones."""
    arrays = unpack_arrays(data)
    if STEP not in arrays:
        raise ValueError(f"These arrays are not an attack state: {sorted(arrays)} lacks {STEP!r}.")

    def table(prefix: str) -> dict[str, Tensor]:
        names = [name for name in arrays if name.startswith(prefix)]
        return {name.removeprefix(prefix): torch.from_numpy(arrays[name]) for name in names}

    return AttackState(int(arrays[STEP]), table(DELTA), table(MEMORY), table(MOMENTUM))
