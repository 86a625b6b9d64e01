"""What an attack leaves between two steps, in memory and as a file, so that one that was cut off goes on as it was."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from trompe_server.array_files import pack_arrays, unpack_arrays
from trompe_server.attack.objective import Textures

__all__ = ["AttackState", "load_state", "save_state", "start"]


@dataclass(frozen=True)
class AttackState:
    """All that a step starts from.

    deltas: the change of each texture after ``step`` steps (sRGB in [0, 1] units); after the last one, the best that
    was found. memory: what the search remembers, by names of its own.
    """

    step: int
    deltas: Textures
    memory: Mapping[str, Tensor] = field(default_factory=dict)

    def to(self, device: torch.device) -> "AttackState":
        """The same state on a device: one that was saved comes back on the CPU."""
        deltas, memory = ({key: value.to(device) for key, value in each.items()} for each in (self.deltas, self.memory))
        return AttackState(self.step, deltas, memory)


def start(textures: Textures) -> AttackState:
    """No change at all."""
    return AttackState(0, {name: torch.zeros_like(texture) for name, texture in textures.items()})


def save_state(state: AttackState) -> bytes:
    """A state as the bytes of an .npz file; exact."""
    tables = {_DELTA: state.deltas, _MEMORY: state.memory}
    arrays = {prefix + name: table[name].cpu().numpy() for prefix, table in tables.items() for name in table}
    return pack_arrays({"step": np.array(state.step)} | arrays, compressed=False)


def load_state(data: bytes) -> AttackState:
    """A state from ``save_state``'s bytes. Raises ``ValueError`` or ``OSError`` where they are damaged."""
    arrays = unpack_arrays(data)
    if "step" not in arrays:
        raise ValueError(f"These arrays are no attack state: there is no 'step' among {sorted(arrays)}.")

    def table(prefix: str) -> dict[str, Tensor]:
        names = [name for name in arrays if name.startswith(prefix)]
        return {name.removeprefix(prefix): torch.from_numpy(arrays[name]) for name in names}

    return AttackState(int(arrays["step"]), table(_DELTA), table(_MEMORY))


_DELTA = "delta:"
_MEMORY = "memory:"
