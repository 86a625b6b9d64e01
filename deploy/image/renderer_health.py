"""Health check of a renderer: it answers a handshake."""

import socket

from trompe_shared.sailenv import REGISTER

with socket.create_connection(("127.0.0.1", 8085), timeout=5) as connection:
    connection.sendall(REGISTER.encode_request(width=1, height=1, gzip=False))
    reader = connection.makefile("rb")
    REGISTER.decode_reply(lambda length: reader.read(length))
