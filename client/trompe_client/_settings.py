"""Address and token of the server: arguments, else the environment."""

import math
import os
from dataclasses import dataclass, field
from typing import Any, Final
from urllib.parse import urlsplit

from trompe_shared.errors import SpecError

DEFAULT_SERVER: Final = "http://127.0.0.1:8000"


@dataclass(frozen=True)
class Connection:
    """A server's address, the access token, and the longest silence in seconds."""

    url: str
    token: str | None = field(repr=False)
    timeout: float
    transport: Any
    """An httpx transport in place of the network, for tests."""

    @classmethod
    def find(cls, url: str | None, *, token: str | None, timeout: float, transport: Any) -> "Connection":
        """Defaults are TROMPE_SERVER and TROMPE_TOKEN. Raises ``SpecError`` for a wrong address, token or timeout."""
        address = url or os.environ.get("TROMPE_SERVER") or DEFAULT_SERVER
        if not (isinstance(timeout, int | float) and 0 < timeout < math.inf):
            raise SpecError(f"`timeout` must be a positive number of seconds, got {timeout!r}.")
        if not (isinstance(address, str) and _is_url(address)):
            raise SpecError(f"The server's URL must be http://HOST:PORT or https://HOST, got {address!r}.")
        secret = str(token or os.environ.get("TROMPE_TOKEN") or "").strip()  # a file's last line has an end
        if not (secret.isascii() and secret.isprintable()):
            raise SpecError("The access token has characters that no token has; copy it again, or see TROMPE_TOKEN.")
        return cls(address.rstrip("/"), secret or None, timeout, transport)


def _is_url(text: str) -> bool:
    try:
        parts = urlsplit(text)
        return parts.scheme in {"http", "https"} and bool(parts.hostname) and parts.port != 0
    except ValueError:  # a port or an IPv6 address that is none
        return False
