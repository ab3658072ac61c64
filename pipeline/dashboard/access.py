"""Who may use the dashboard: hosts, sessions, a token, and requests that other pages cannot make.

A page of somebody else, open in the same browser, may send requests to any address. So the Host header must name this
machine (a name that was bent to its address, "DNS rebinding", does not), a POST must come from a page of ours (Origin)
and carry what only such a page knows, and nothing is changed by a GET.
"""

from __future__ import annotations

import hashlib
import hmac
import ipaddress
import math
import os
import secrets
import shlex
import socket
import stat
import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

from pipeline.errors import PipelineError

LEAST_TOKEN_LENGTH = 22
LEAST_TOKEN_BITS = 72.0
"""Of a token, if each character were drawn as often as it is in it: 22 that were drawn have 78 and more."""
MOST_TOKEN_BYTES = 1024
OF_OTHERS = stat.S_IRGRP | stat.S_IWGRP | stat.S_IROTH | stat.S_IWOTH
SESSION_S = 7 * 24 * 3600.0
"""So long a browser is known [s]."""


@dataclass(frozen=True)
class Access:
    """Decides who may use it.

    Attributes:
        host: the address that it listens on.
        port: the port.
        token: what a browser must show once; None: every program on this machine may use it.
        key: signs the sessions; those of another key count for nothing.
    """

    host: str
    port: int
    token: str | None
    key: bytes = field(default_factory=lambda: secrets.token_bytes(32), repr=False)
    _names: frozenset[str] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        names = {"localhost", self.host.lower()}
        if not is_loopback(self.host):  # asked once: this may ask a name server, which may take its time
            names |= {socket.gethostname().lower(), socket.getfqdn().lower()}
        object.__setattr__(self, "_names", frozenset(names))

    @property
    def cookie(self) -> str:
        """Name of the session's cookie; browsers do not tell ports apart."""
        return f"farm-{self.port}"

    def knows_host(self, header: str) -> bool:
        """Whether a Host header names this machine: by an address, which nobody can bend, or by its own name."""
        name = host_of(header)
        if is_address(name):
            return not is_loopback(self.host) or ipaddress.ip_address(name).is_loopback
        return name in self._names

    def is_token(self, given: str) -> bool:
        """Whether this is the token; takes the same time whatever is given."""
        return self.token is not None and hmac.compare_digest(given.encode(), self.token.encode())

    def new_session(self) -> str:
        """A session's cookie: its name, which holds when it ends, signed."""
        name = f"{secrets.token_urlsafe(24)}.{int(time.time() + SESSION_S)}"
        return f"{name}.{self._sign('session', name)}"

    def session(self, cookie: str | None) -> str | None:
        """The name of the session that a cookie is of; None if it is none of ours, or has ended."""
        name, _, signature = (cookie or "").rpartition(".")
        if not hmac.compare_digest(signature.encode(), self._sign("session", name).encode()):
            return None
        return name if time.time() < int(name.rpartition(".")[2]) else None

    def form_token(self, session: str) -> str:
        """What a page of a session puts into its forms."""
        return self._sign("form", session)

    def is_form_token(self, session: str, given: str) -> bool:
        """Whether a form came from a page of this session."""
        return hmac.compare_digest(given.encode(), self.form_token(session).encode())

    def _sign(self, purpose: str, text: str) -> str:
        return hmac.new(self.key, f"{purpose}:{text}".encode(), hashlib.sha256).hexdigest()


def access_of(host: str, port: int, token_file: Path | None) -> Access:
    """Who may use it, as the command line says: where others can reach it, only those who have a token.

    Args:
        host: the address that it listens on.
        port: the port.
        token_file: holds the token; None: one is made up where it is needed.

    Raises:
        PipelineError: the file cannot be read, others may read or write it, or its token is not hard to guess.
    """
    if token_file is None:
        return Access(host, port, None if is_loopback(host) else secrets.token_urlsafe(32))
    try:
        with token_file.open("rb") as file:
            mode, content = os.fstat(file.fileno()).st_mode, file.read(MOST_TOKEN_BYTES + 1)
        token = content.decode().strip()
    except (OSError, UnicodeDecodeError) as error:
        raise PipelineError(f"--token-file: {token_file} cannot be read: {error}") from error
    if mode & OF_OTHERS:
        raise PipelineError(
            f"--token-file: other users may read or write {token_file}: chmod 600 {shlex.quote(str(token_file))}, and "
            "draw a new token if they may know this one"
        )
    is_text = token.isascii() and token.isprintable() and len(content) <= MOST_TOKEN_BYTES
    if not is_text or len(token) < LEAST_TOKEN_LENGTH or _bits(token) < LEAST_TOKEN_BITS:
        raise PipelineError(
            f"--token-file: {token_file} must hold {LEAST_TOKEN_LENGTH} characters at least, drawn at random, in one "
            "line, as from: python3 -c 'import secrets; print(secrets.token_urlsafe(32))'"
        )
    # A key of the token's own: sessions outlive the program then. Its making is slow, so that nobody who sees a cookie
    # can try tokens by the million.
    return Access(host, port, token, key=hashlib.scrypt(token.encode(), salt=b"sessions", n=2**14, r=8, p=1, dklen=32))


def _bits(token: str) -> float:
    """How many bits a token's characters tell, by Shannon's entropy of how often each is in it; words tell fewer."""
    return sum(-count * math.log2(count / len(token)) for count in Counter(token).values())


def host_of(header: str) -> str:
    """The name in a Host header, without its port and without brackets, in lower case."""
    name = header.strip().lower()
    if name.startswith("["):
        return name[1:].partition("]")[0]
    return name.partition(":")[0] if name.count(":") == 1 else name


def is_address(name: str) -> bool:
    """Whether a host is named by an IP address."""
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


def is_loopback(host: str) -> bool:
    """Whether an address is reached from this machine only."""
    return host.lower() == "localhost" or (is_address(host) and ipaddress.ip_address(host).is_loopback)
