"""Random numbers that depend on a seed and on the images they are drawn for, and on nothing that was drawn before."""

from hashlib import blake2b

import torch
from torch import Tensor

__all__ = ["generator_for"]


def generator_for(images: Tensor, seed: int) -> torch.Generator:
    """A generator on the CPU; every bit of the images and of the seed (64 bits, signed) counts.

    So an attack that is resumed draws as if it had not stopped.
    """
    key = seed.to_bytes(8, "little", signed=True)
    digest = blake2b(images.detach().cpu().numpy().tobytes(), digest_size=8, key=key).digest()
    return torch.Generator().manual_seed(int.from_bytes(digest, "little") >> 1)
