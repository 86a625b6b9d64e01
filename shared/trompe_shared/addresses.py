"""Network addresses as users write them."""

import ipaddress
import re


def host_and_port(text: str) -> tuple[str, int]:
    """The parts of HOST:PORT; an IPv6 host may have brackets. Raises ``ValueError`` for any other text."""
    host, _, port = text.rpartition(":")
    host = host.strip("[]")
    if not _is_host(host) or not port.isdecimal() or int(port) > 65535:
        raise ValueError(f"{text!r} is not HOST:PORT, e.g. 127.0.0.1:8085")
    return host, int(port)


def without_password(url: str) -> str:
    """``url`` as messages may show it."""
    return re.sub(r"(://[^:/@]*:).*@", r"\1***@", url)


def is_loopback(host: str) -> bool:
    """Whether an address or a name is of this machine alone."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def _is_host(text: str) -> bool:
    """Whether it is a name or an address, not a URL or a part of an IPv6 address."""
    try:
        ipaddress.ip_address(text)
    except ValueError:
        if not re.fullmatch(r"[^\s:/\[\]]+", text):
            return False
    try:
        text.encode("idna")
    except UnicodeError:
        return False
    return True
