"""Who may use the workbench: one-time tokens, a session cookie, checks of Host and Origin, and security headers.

A page of another origin, a name that was bound to this machine's address, and another user of this machine must all
be refused. The token in the printed address is used once. Its first use sets a cookie that no script reads and that
the browser sends to this origin only.
"""

import secrets
from collections import deque
from collections.abc import Callable
from hashlib import sha256
from ipaddress import ip_address
from typing import Any, Final
from urllib.parse import parse_qs

from starlette.datastructures import Headers
from starlette.requests import cookie_parser
from starlette.responses import JSONResponse, PlainTextResponse, RedirectResponse, Response

ENTRY: Final = "/enter"
"""Path of the printed address; its parameter `token` is used once."""
READY: Final = "/readyz"
"""Path that needs no session: whoever restarts the workbench asks there."""
MOST_SESSIONS: Final = 64
"""Largest number of browsers that have a session; the oldest session ends when another begins."""
POLICY: Final = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data: blob:; connect-src 'self'; "
    "font-src 'self'; base-uri 'none'; frame-ancestors 'none'; form-action 'self'"
)
"""Content security policy of every response."""
HEADERS: Final = {
    "Content-Security-Policy": POLICY,
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Permissions-Policy": "camera=(), geolocation=(), microphone=()",
}
"""Headers of every response, beside `Cache-Control`."""
NO_SESSION: Final = "this browser has no session: open the newest address that `socast serve` printed"
USED: Final = "this address was used before, or is wrong: open the newest address that `socast serve` printed"
_REFUSED: Final = 1008  # close code of a WebSocket: policy violation


class Sessions:
    """Hold the token of the next browser and the sessions of those that have entered.

    Parameters
    ----------
    port : int
        Port of the server. Cookies do not tell ports apart, so the name of the cookie does.
    """

    def __init__(self, port: int) -> None:
        self.cookie = f"socast_session_{port}"
        self.token = secrets.token_urlsafe(32)
        self._known: deque[bytes] = deque(maxlen=MOST_SESSIONS)

    def enter(self, token: str) -> str | None:
        """Return the secret of a new session and replace the token; None for a wrong token."""
        if not secrets.compare_digest(token.encode(), self.token.encode()):
            return None
        self.token = secrets.token_urlsafe(32)
        secret = secrets.token_urlsafe(32)
        self._known.append(_digest(secret))
        return secret

    def knows(self, secret: str) -> bool:
        """Return whether a secret is that of a session, in a time that does not depend on the secret."""
        given = _digest(secret)
        return any([secrets.compare_digest(given, known) for known in self._known])  # noqa: C419 - compares all


class AccessControl:
    """Refuse requests and WebSockets that do not come from a page of this server in a browser that has entered.

    Parameters
    ----------
    announce : callable
        Function that is called after a token was used, so that the next address can be printed.
    """

    def __init__(
        self, application: Any, sessions: Sessions, host: str, port: int, announce: Callable[[], None]
    ) -> None:
        self._application, self._sessions, self._port = application, sessions, port
        self._host, self._announce = host.lower(), announce
        self._on_loopback = is_loopback(host)

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
        """Answer a request or open a WebSocket, or refuse it."""
        if scope["type"] not in {"http", "websocket"}:
            await self._application(scope, receive, send)
            return
        headers, is_socket = Headers(scope=scope), scope["type"] == "websocket"
        refusal = self._find_fault(scope, headers, is_socket=is_socket)
        if refusal is None and not is_socket and scope["path"] == ENTRY:
            await self._enter(scope)(scope, receive, _add_headers(send))
        elif refusal is None and (scope["path"] == READY or self._has_session(headers)):
            await self._application(scope, receive, send if is_socket else _add_headers(send))
        elif is_socket:
            await receive()  # the server expects that the handshake is read before it is refused
            await send({"type": "websocket.close", "code": _REFUSED, "reason": refusal or NO_SESSION})
        else:
            await refuse(scope["path"], refusal or NO_SESSION)(scope, receive, _add_headers(send))

    def _has_session(self, headers: Headers) -> bool:
        """Return whether the request carries the cookie of a session."""
        return self._sessions.knows(cookie_parser(headers.get("cookie", "")).get(self._sessions.cookie, ""))

    def _enter(self, scope: Any) -> Response:
        """Begin a session with the token of the address, which is used up, and redirect to the address without it."""
        token = parse_qs(scope["query_string"].decode("ascii", "replace")).get("token", [""])[0]
        secret = self._sessions.enter(token) if scope["method"] == "GET" else None
        if secret is None:
            return refuse(ENTRY, USED)
        self._announce()
        response = RedirectResponse("/", 303)
        response.set_cookie(self._sessions.cookie, secret, path="/", httponly=True, samesite="strict")
        return response

    def _find_fault(self, scope: Any, headers: Headers, *, is_socket: bool) -> str | None:
        """Return why a request is refused whatever its cookie is; None where nothing is wrong."""
        hosts = headers.getlist("host")
        if len(hosts) != 1 or not self._is_our_host(hosts[0]):
            return "the header Host does not name this server: open the address that `socast serve` printed"
        origins, method = headers.getlist("origin"), scope.get("method", "GET")
        if any(origin != f"http://{hosts[0]}" for origin in origins):
            return "the request comes from a page of another origin"
        if headers.get("sec-fetch-site", "none") not in {"none", "same-origin"}:
            return "the request comes from a page of another site: type the address, or paste it"
        if not origins and (is_socket or method not in {"GET", "HEAD"}):
            return "the header Origin is missing: requests that change something come from the pages of the workbench"
        return None

    def _is_our_host(self, given: str) -> bool:
        """Return whether a Host header names this server by a name that nobody else can bind to its address."""
        name, _, port = given.lower().rpartition(":")
        if not name:
            name, port = given.lower(), "80"
        if port != str(self._port):
            return False
        if name in {"localhost", self._host}:
            return name != "localhost" or self._on_loopback or is_any(self._host)
        return is_loopback(name) if self._on_loopback else _is_number(name)


def refuse(path: str, words: str, code: int = 403) -> Response:
    """Return a refusal: one JSON line for the interface, one line of text for a page."""
    if path.startswith("/api/"):
        return JSONResponse({"error": words}, code)
    return PlainTextResponse(f"socast: {words}\n", code)


def is_loopback(host: str) -> bool:
    """Return whether a host is reached from this machine only.

    Examples
    --------
    >>> is_loopback("127.0.0.1"), is_loopback("[::1]"), is_loopback("localhost"), is_loopback("10.0.0.5")
    (True, True, True, False)
    """
    return host == "localhost" or (_is_number(host) and ip_address(host.strip("[]")).is_loopback)


def is_any(host: str) -> bool:
    """Return whether a host stands for all addresses of this machine."""
    return _is_number(host) and ip_address(host.strip("[]")).is_unspecified


def _is_number(host: str) -> bool:
    """Return whether a host is an IP address, which no name server can redirect."""
    try:
        ip_address(host.strip("[]"))
    except ValueError:
        return False
    return True


def _digest(secret: str) -> bytes:
    """Return the digest of a secret, of one length."""
    return sha256(secret.encode("utf-8", "replace")).digest()


def _add_headers(send: Any) -> Any:
    """Return a function that sends a response with the security headers."""

    async def send_with_headers(message: Any) -> None:
        if message["type"] == "http.response.start":
            present = [(name, value) for name, value in message["headers"] if name.lower() != b"server"]
            added = [(name.lower().encode(), value.encode()) for name, value in HEADERS.items()]
            if not any(name.lower() == b"cache-control" for name, _ in present):
                added.append((b"cache-control", b"no-store"))
            message = message | {"headers": [*present, *added]}
        await send(message)

    return send_with_headers
