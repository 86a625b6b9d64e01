"""Random numbers determined by a seed and by the images they are for, not by earlier draws."""

from hashlib import blake2b

import torch
from torch import Tensor


def generator_for(images: Tensor, seed: int) -> torch.Generator:
    """A CPU generator seeded by every bit of the images and of ``seed`` (64 bits, signed).

    A resumed attack therefore draws the same numbers as an uninterrupted one.
    """
    data = images.detach().cpu().numpy().tobytes()
    return seeded_generator(data, key=seed.to_bytes(8, "little", signed=True))


def seeded_generator(data: bytes, *, key: bytes = b"") -> torch.Generator:
    """A CPU generator seeded by every bit of ``data`` and ``key``."""
    digest = blake2b(data, digest_size=8, key=key).digest()
    return torch.Generator().manual_seed(int.from_bytes(digest, "little") >> 1)
