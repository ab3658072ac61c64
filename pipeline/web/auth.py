"""Access to pages: hosts, tokens, sessions, and the gate that every request of the dashboard passes.

A page of another site, open in the same browser, may send requests to any address. So the Host header must name this
machine (a name that was bent to its address, "DNS rebinding", does not), a POST must come from a page of ours (Origin)
and carry what only such a page knows, and nothing is changed by a GET.

Starlette's own middleware is not used: its list of trusted hosts holds names, not "any address of this machine" nor
IPv6, and its sessions grow younger with every answer, while ours end a week after the token was shown.
"""

import hashlib
import hmac
import ipaddress
import math
import os
import re
import secrets
import shlex
import socket
import stat
import time
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from urllib.parse import parse_qs

from starlette.requests import ClientDisconnect, Request
from starlette.responses import Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from pipeline.base.errors import PipelineError

LEAST_TOKEN_LENGTH = 22
LEAST_TOKEN_BITS = 72.0  # by the frequencies of its characters: 22 that were drawn have 78 and more
MOST_TOKEN_BYTES = 1024
OF_OTHERS = stat.S_IRGRP | stat.S_IWGRP | stat.S_IROTH | stat.S_IWOTH
SESSION_S = 7 * 24 * 3600.0
MOST_BODY_BYTES = 4096

POLICY = "; ".join(
    (
        "default-src 'none'",
        *(f"{kind}-src 'self'" for kind in ("script", "style", "img", "media", "connect")),
        "form-action 'self'",
        "base-uri 'none'",
        "frame-ancestors 'none'",
    )
)
HEADERS = {
    "content-security-policy": POLICY,
    "x-content-type-options": "nosniff",
    "x-frame-options": "DENY",
    "referrer-policy": "same-origin",  # "no-referrer" would take the Origin from our own forms
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
    "permissions-policy": "camera=(), microphone=(), geolocation=()",
    "cache-control": "no-store",
}

_HOST = re.compile(r"(?:\[(?P<address>[0-9a-f:.]+)\]|(?P<name>[a-z0-9._-]+))(?::[0-9]{1,5})?")
"""RFC 9110, 7.2, without user names and escapes, which no address of ours has."""

Refuse = Callable[[Request, int, str], Response]


@dataclass(frozen=True)
class Access:
    """Rules of access to one address."""

    host: str  # the address that it listens on
    port: int  # the port
    token: str | None  # secret that a browser must show once; None: every program on this machine may use it
    # signs the sessions; those of another key are invalid
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
        """Name of a cookie's session; None if it is none of ours, or has ended."""
        name, _, signature = (cookie or "").rpartition(".")
        if not hmac.compare_digest(signature.encode(), self._sign("session", name).encode()):
            return None
        return name if time.time() < int(name.rpartition(".")[2]) else None

    def form_token(self, session: str) -> str:
        """Secret that the forms of a session's pages carry."""
        return self._sign("form", session)

    def is_form_token(self, session: str, given: str) -> bool:
        """Whether a form came from a page of this session."""
        return hmac.compare_digest(given.encode(), self.form_token(session).encode())

    def _sign(self, purpose: str, text: str) -> str:
        return hmac.new(self.key, f"{purpose}:{text}".encode(), hashlib.sha256).hexdigest()


def access_of(host: str, port: int, token_file: Path | None) -> Access:
    """Access as the command line asks for it: an address that others reach needs a token, drawn if no file holds it.

    Raises PipelineError: the file cannot be read, others may read or write it, or its token is not hard to guess.
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
    # A key of the token's own: sessions outlive the program then. It is slow to derive, so that nobody who sees a
    # cookie can try tokens by the million.
    return Access(host, port, token, key=hashlib.scrypt(token.encode(), salt=b"sessions", n=2**14, r=8, p=1, dklen=32))


def _bits(token: str) -> float:
    """Information in a token's characters [bit]: Shannon's entropy of their frequencies; words have less."""
    return sum(-count * math.log2(count / len(token)) for count in Counter(token).values())


def host_of(header: str) -> str:
    """The name in a Host header, without its port and without brackets, in lower case; "" if it is no such header."""
    found = _HOST.fullmatch(header.strip().lower())
    return (found["address"] or found["name"]) if found else ""


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


class Gate:
    """Middleware that passes requests whose host, session and origin are right, and adds `HEADERS` to every answer.

    `scope["session"]` is the session's name behind it. The answer to a request that may not pass is what `refuse` makes
    of a status and a sentence; the page that asks for the token is `ask`'s, with a sentence about the one that was
    given, and the one that leads on to the farm is `welcome`'s.
    """

    def __init__(
        self,
        app: ASGIApp,
        access: Access,
        *,
        refuse: Refuse,
        ask: Callable[[Request, str], Response],
        welcome: Callable[[Request], Response],
    ) -> None:
        self._app, self._access = app, access
        self._refuse, self._ask, self._welcome = refuse, ask, welcome

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle one request."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        request = Request(scope, receive)
        cookie: str | None = None

        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                present = {name for name, _ in message["headers"]}
                added = [(name.encode(), text.encode()) for name, text in HEADERS.items()]
                message["headers"] = [*message["headers"], *(each for each in added if each[0] not in present)]
                if cookie is not None:
                    text = f"{self._access.cookie}={cookie}; Path=/; HttpOnly; SameSite=Strict"
                    message["headers"].append((b"set-cookie", text.encode()))
            await send(message)

        answer: ASGIApp
        with suppress(ClientDisconnect):  # in the middle of a form: nothing was asked, and nobody waits for an answer
            answer, cookie = await self._decide(request)
            await answer(scope, request.receive, send_with_headers)

    async def _decide(self, request: Request) -> tuple[ASGIApp, str | None]:
        """Application that answers a request, and the cookie of a new session, if it begins one."""
        access = self._access
        if (refusal := _refusal(request, access)) is not None:
            return self._refuse(request, *refusal), None
        path = request.scope["path"]  # as routed; that of `request.url` depends on the Host header, too
        if path.startswith("/static/"):  # the same for everybody
            return self._app, None
        if access.token is not None:
            given = None
            if path == "/enter" and request.method == "POST":
                given = (await form_of(request)).get("token", "")
            elif request.method == "GET":
                given = request.query_params.get("token")
            if given is not None and not access.is_token(given):
                return self._ask(request, "This is not the token."), None
            if given is not None:
                return self._welcome(request), access.new_session()
        return self._with_session(request)

    def _with_session(self, request: Request) -> tuple[ASGIApp, str | None]:
        access = self._access
        session, cookie = access.session(request.cookies.get(access.cookie)), None
        if session is None and access.token is not None:
            return self._ask(request, ""), None
        if session is None and request.method == "POST":
            return self._refuse(request, 403, "the dashboard was started anew; load the page again"), None
        if session is None:
            cookie = access.new_session()
            session = access.session(cookie)
        request.scope["session"] = session
        return self._app, cookie


def _refusal(request: Request, access: Access) -> tuple[int, str] | None:
    """Status and sentence for a request that does not come from a page of ours; None for one that may."""
    if "content-length" in request.headers and "transfer-encoding" in request.headers:
        return 400, "a request has one length: of two, a proxy in between may read the other"
    if not access.knows_host(request.headers.get("host", "")):
        return 421, "this address is not the dashboard's; use the one that it printed"
    if request.method == "POST" and not _is_own(request):
        return 403, "this was not sent by a page of the dashboard"
    return None


async def form_of(request: Request) -> dict[str, str]:
    """The fields of a form; one that is longer than any of ours counts as empty. Raises ClientDisconnect."""
    body = b""
    async for chunk in request.stream():
        body += chunk
        if len(body) > MOST_BODY_BYTES:
            return {}
    fields = parse_qs(body.decode("utf-8", errors="replace"), keep_blank_values=True)
    return {name: values[0] for name, values in fields.items()}


def _is_own(request: Request) -> bool:
    """Whether a page of ours sent a request, as browsers tell; no page can make them tell anything else."""
    if request.headers.get("sec-fetch-site", "same-origin") != "same-origin":
        return False
    return request.headers.get("origin") == f"{request.url.scheme}://{request.headers.get('host', '')}"
