"""Where the server is, and who asks: arguments, else the environment."""

import os
from dataclasses import dataclass, field
from typing import Any, Final

from trompe_shared.errors import SpecError

__all__ = ["DEFAULT_SERVER", "Connection"]

DEFAULT_SERVER: Final = "http://127.0.0.1:8000"


@dataclass(frozen=True)
class Connection:
    """A server's address, the token that it is shown, and how long it may be silent, seconds."""

    url: str
    token: str | None = field(repr=False)
    timeout: float
    transport: Any
    """What carries the requests in place of the network: an httpx transport (a mock, in tests)."""

    @classmethod
    def find(cls, url: str | None, *, token: str | None, timeout: float, transport: Any) -> "Connection":
        """What is not given is taken from TROMPE_SERVER and TROMPE_TOKEN. Raises ``SpecError`` for a wrong address."""
        address = (url or os.environ.get("TROMPE_SERVER") or DEFAULT_SERVER).rstrip("/")
        if not address.startswith(("http://", "https://")):
            raise SpecError(f"The server's URL must begin with http:// or https://, got {address!r}.")
        return cls(address, token or os.environ.get("TROMPE_TOKEN") or None, timeout, transport)
