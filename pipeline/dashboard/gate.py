"""What every request passes before a page sees it, and the headers that every answer carries."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from typing import TYPE_CHECKING
from urllib.parse import parse_qs

from starlette.requests import ClientDisconnect, Request
from starlette.responses import Response

from pipeline.dashboard.access import Access

if TYPE_CHECKING:
    from starlette.types import ASGIApp, Message, Receive, Scope, Send

POLICY = "; ".join(
    (
        "default-src 'none'",
        "script-src 'self'",
        "style-src 'self'",
        "img-src 'self'",
        "media-src 'self'",
        "connect-src 'self'",
        "form-action 'self'",
        "base-uri 'none'",
        "frame-ancestors 'none'",
    )
)
REPORT_POLICY = (
    "default-src 'none'; style-src 'unsafe-inline'; img-src data:; media-src data:; frame-ancestors 'none'; sandbox"
)
"""A report carries its own style, pictures and film. It lies in a job's folder, so nothing in it is run."""
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
MOST_BODY_BYTES = 4096

Refuse = Callable[[Request, int, str], Response]


class Gate:
    """Lets requests through whose host, session and origin are right; scope["session"] names the session then.

    Args:
        app: what comes after it.
        access: decides.
        refuse: makes the answer to a request that may not pass, of a status and a sentence.
        ask: makes the page that asks for the token, with a sentence about the one that was given.
        welcome: makes the page that leads on to the farm.
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
        self._app = app
        self._access = access
        self._refuse = refuse
        self._ask = ask
        self._welcome = welcome

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
        """What answers a request, and the cookie of a new session, if it begins one."""
        refusal = self._refusal(request)
        if refusal is not None:
            return refusal, None
        path = request.scope["path"]  # what is routed by; that of `request.url` comes of the Host header, too
        if path.startswith("/static/"):  # the same for everybody
            return self._app, None
        access = self._access
        if access.token is not None:
            if path == "/enter" and request.method == "POST":
                return await self._enter((await form_of(request)).get("token", ""), request)
            if "token" in request.query_params and request.method == "GET":
                return await self._enter(request.query_params["token"], request)
        return self._with_session(request)

    def _refusal(self, request: Request) -> Response | None:
        if not self._access.knows_host(request.headers.get("host", "")):
            return self._refuse(request, 421, "this address is not the dashboard's; use the one that it printed")
        if request.method == "POST" and not _is_own(request):
            return self._refuse(request, 403, "this was not sent by a page of the dashboard")
        return None

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

    async def _enter(self, token: str, request: Request) -> tuple[ASGIApp, str | None]:
        if not self._access.is_token(token):
            return self._ask(request, "This is not the token."), None
        return self._welcome(request), self._access.new_session()


async def form_of(request: Request) -> dict[str, str]:
    """The fields of a form that was sent; what is longer than any form of ours counts as empty.

    Raises:
        ClientDisconnect: it was cut off.
    """
    body = b""
    async for chunk in request.stream():
        body += chunk
        if len(body) > MOST_BODY_BYTES:
            return {}
    fields = parse_qs(body.decode("utf-8", errors="replace"), keep_blank_values=True)
    return {name: values[0] for name, values in fields.items()}


def _is_own(request: Request) -> bool:
    """Whether a page of ours sent a request, as browsers tell; no page can make them tell otherwise."""
    if request.headers.get("sec-fetch-site", "same-origin") != "same-origin":
        return False
    return request.headers.get("origin") == f"{request.url.scheme}://{request.headers.get('host', '')}"
