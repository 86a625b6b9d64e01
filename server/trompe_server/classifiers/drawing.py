"""Random numbers determined by a seed and by the images they are for, not by earlier draws."""

from hashlib import blake2b

import torch
from torch import Tensor

__all__ = ["generator_for"]


def generator_for(images: Tensor, seed: int) -> torch.Generator:
    """A CPU generator seeded by every bit of the images and of ``seed`` (64 bits, signed).

    A resumed attack therefore draws the same numbers as an uninterrupted one.
    """
    key = seed.to_bytes(8, "little", signed=True)
    digest = blake2b(images.detach().cpu().numpy().tobytes(), digest_size=8, key=key).digest()
    return torch.Generator().manual_seed(int.from_bytes(digest, "little") >> 1)
