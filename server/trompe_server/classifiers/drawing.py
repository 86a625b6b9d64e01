"""Random numbers determined by a seed and by the images they are for, not by earlier draws."""

from hashlib import blake2b

import torch


def seeded_generator(data: bytes, *, key: bytes = b"") -> torch.Generator:
    """A CPU generator seeded by every bit of ``data`` and ``key``, so that a resumed attack draws the same numbers."""
    digest = blake2b(data, digest_size=8, key=key).digest()
    return torch.Generator().manual_seed(int.from_bytes(digest, "little") >> 1)
