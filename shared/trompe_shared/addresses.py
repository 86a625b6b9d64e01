"""Network addresses as users write them."""

import ipaddress


def host_and_port(text: str) -> tuple[str, int]:
    """The parts of HOST:PORT; an IPv6 host may have brackets. Raises ``ValueError`` for any other text."""
    host, _, port = text.rpartition(":")
    if not host or not port.isdecimal() or int(port) > 65535:
        raise ValueError(f"{text!r} is not HOST:PORT, e.g. 127.0.0.1:8085")
    try:
        host.encode("idna")
    except UnicodeError as error:
        raise ValueError(f"{text!r} is not HOST:PORT: {host!r} cannot be a host's name") from error
    return host.strip("[]"), int(port)


def is_loopback(host: str) -> bool:
    """Whether an address or a name is of this machine alone."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"
