"""What a scan of ports, or a browser that looks around, sends to a page's port."""

import socket
import ssl
import struct
from contextlib import suppress

UPGRADE = b"Connection: Upgrade\r\nUpgrade: websocket\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n"
SENT = (
    b"",
    bytes(range(128, 256)) + b"\r\n\r\n",
    b"\x00\x01\x02\xff",
    b"\r\n\r\n",
    b"SSH-2.0-probe\r\n",
    b"GET /\r\n",
    b"GET / HT",
    b"GET / HTTP/1.1\r\n\r\n",
    b"GET /" + b"a" * 100_000 + b" HTTP/1.1\r\n\r\n",
    b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n",
    *(
        f"{method} HTTP/1.1\r\nHost: 127.0.0.1:PORT\r\n\r\n".encode()
        for method in (
            "HEAD /",
            "OPTIONS /",
            "OPTIONS *",
            "POST /",
            "PROPFIND /",
            "CONNECT a.b:443",
            "GET /favicon.ico",
        )
    ),
    b"GET / HTTP/1.1\r\nHost: 127.0.0.1:PORT\r\n" + UPGRADE + b"Sec-WebSocket-Version: 7\r\n\r\n",
    b"GET / HTTP/1.1\r\nHost: 127.0.0.1:PORT\r\n" + UPGRADE + b"Sec-WebSocket-Version: 13\r\n\r\n\x82\x05hello\xff",
)


def probe(port: int) -> None:
    """Send all of it, each once with an orderly end and once with a reset, and greet by TLS."""
    for data in SENT:
        for resets in (False, True):
            with socket.create_connection(("127.0.0.1", port), timeout=20) as probing, suppress(OSError):
                if resets:
                    probing.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
                probing.sendall(data.replace(b"PORT", str(port).encode()))
                if not resets:
                    probing.shutdown(socket.SHUT_WR)
                    probing.recv(100)
    context = ssl.create_default_context()
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    with suppress(OSError), context.wrap_socket(socket.create_connection(("127.0.0.1", port), timeout=20)):
        pass
