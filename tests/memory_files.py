"""A job's files in a dictionary, for tests that look at all of them."""

import json

import numpy as np
from numpy.typing import NDArray

from trompe_server.array_files import unpack_arrays
from trompe_shared.api import Result


class MemoryArtifacts:
    """``Artifacts`` that are gone with the test."""

    def __init__(self) -> None:
        self.files: dict[str, bytes] = {}

    def read(self, name: str) -> bytes:
        if name not in self.files:
            raise FileNotFoundError(name)
        return self.files[name]

    def write(self, name: str, data: bytes) -> None:
        self.files[name] = data

    def exists(self, name: str) -> bool:
        return name in self.files

    def result(self) -> Result:
        return Result.model_validate_json(self.files["result.json"])

    def images(self, name: str) -> dict[str, NDArray[np.uint8]]:
        return unpack_arrays(self.read(f"{name}.npz"))

    def lasting(self) -> dict[str, bytes]:
        """All files, without what a clock wrote into them."""
        untimed = {name: data for name, data in self.files.items() if not name.startswith("seconds-")}
        result = json.loads(untimed.pop("result.json", b"{}"))
        result.pop("seconds", None)
        return untimed | {"result.json": json.dumps(result).encode()}
