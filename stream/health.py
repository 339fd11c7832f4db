"""The web server of the live service: `/metrics` for Prometheus, `/livez` and `/readyz` for whoever restarts it."""

import logging
import socket
from contextlib import suppress
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler
from ipaddress import ip_address
from socketserver import TCPServer, ThreadingMixIn
from threading import BoundedSemaphore, Thread, Timer
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from socast.core.errors import SettingsError
from socast.stream.closeable import Closeable
from socast.stream.service_status import ServiceStatus, describe_role

if TYPE_CHECKING:
    from prometheus_client import CollectorRegistry

LOOPBACK_HOST: Final = "127.0.0.1"
"""Host at which the server listens if the address is a port alone."""
CLIENT_S: Final = 5.0
"""Longest time that a request may take, from the connection to the end of the answer. [s]"""
MOST_CLIENTS: Final = 16
"""Largest number of requests at the same time; the oldest of more is closed."""
POLL_S: Final = 0.1
"""Time within which the server notices that it is closed. [s]"""
_PLAIN: Final = "text/plain; charset=utf-8"

_log = logging.getLogger("socast.metrics")


class HttpAddress(NamedTuple):
    """Hold where the server listens.

    Parameters
    ----------
    port : int
        Number of the port; 0 for any free port.
    """

    host: str
    port: int

    def __str__(self) -> str:
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"{host}:{self.port}"


def parse_http_address(text: str) -> HttpAddress:
    """Return an address of the form PORT, HOST:PORT or [IPV6]:PORT.

    Examples
    --------
    >>> parse_http_address("9464"), parse_http_address("[::1]:9464")
    (HttpAddress(host='127.0.0.1', port=9464), HttpAddress(host='::1', port=9464))
    """
    host, _, port = text.strip().rpartition(":")
    bracketed = host.startswith("[") and host.endswith("]")
    if port.isascii() and port.isdecimal() and int(port) <= 65_535 and (bracketed or ":" not in host):
        return HttpAddress((host[1:-1] if bracketed else host) or LOOPBACK_HOST, int(port))
    raise SettingsError(
        f"--metrics is '{text}'; give a port from 0 to 65535, or HOST:PORT such as 127.0.0.1:9464 or [::1]:9464"
    )


class HealthServer(Closeable):
    """Answer web requests on the service from threads of its own.

    Attributes
    ----------
    address : HttpAddress
        Where the server listens; a free port replaces port 0.
    """

    def __init__(self, address: HttpAddress, status: ServiceStatus, registry: "CollectorRegistry") -> None:
        try:
            family, _, _, _, place = socket.getaddrinfo(*address, type=socket.SOCK_STREAM)[0]
            self._server = _Server(family, place, status, registry)
        except OSError as error:
            raise SettingsError(
                f"cannot serve metrics at {address}: {error.strerror}; choose another address with --metrics"
            ) from error
        host, port = self._server.server_address[:2]
        self.address = HttpAddress(str(host), int(port))
        if not ip_address(str(host).partition("%")[0]).is_loopback:
            _log.warning(
                "whoever reaches %s can read the metrics, without a password and not encrypted: "
                "let a firewall admit Prometheus alone",
                self.address,
            )
        self._thread = Thread(target=self._server.serve_forever, args=(POLL_S,), name="metrics", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop listening; requests in progress end with the process."""
        self._server.shutdown()
        self._server.server_close()


class _Server(ThreadingMixIn, TCPServer):
    """Answer each request in a thread, up to `MOST_CLIENTS` at a time."""

    allow_reuse_address = True
    daemon_threads = True
    block_on_close = False
    request_queue_size = MOST_CLIENTS

    def __init__(
        self, family: socket.AddressFamily, place: Any, status: ServiceStatus, registry: "CollectorRegistry"
    ) -> None:
        self.address_family = family
        self.status, self.registry = status, registry
        self._free = BoundedSemaphore(MOST_CLIENTS)
        self._requests: dict[Any, None] = {}  # the oldest first
        super().__init__(place, _Handler)

    def process_request(self, request: Any, client_address: Any) -> None:
        """Answer a request in a thread, in the place of the oldest where too many are open."""
        if not self._free.acquire(blocking=False):
            for oldest in list(self._requests)[:1]:
                _end(oldest)
            if not self._free.acquire(timeout=POLL_S):
                self.shutdown_request(request)
                return
        self._requests[request] = None
        super().process_request(request, client_address)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        """Answer a request, and free its place; what comes too slowly is cut off."""
        deadline = Timer(CLIENT_S, _end, [request])
        deadline.daemon = True
        try:
            deadline.start()
            super().process_request_thread(request, client_address)
        finally:
            deadline.cancel()
            self._requests.pop(request, None)
            self._free.release()

    def handle_error(self, request: Any, client_address: Any) -> None:  # noqa: ARG002 - as in the base class
        """Log a request that failed in one line; a client that has gone is no failure of the service."""
        _log.debug("request of %s failed", client_address, exc_info=True)


def _end(request: socket.socket) -> None:
    """End a connection, also for a thread that reads from it."""
    with suppress(OSError):  # it has ended
        request.shutdown(socket.SHUT_RDWR)


class _Handler(BaseHTTPRequestHandler):
    """Answer GET and HEAD of the three pages."""

    server: _Server
    server_version = "socast"
    sys_version = ""
    timeout = CLIENT_S

    def do_GET(self) -> None:
        """Answer with headers and content."""
        code, kind, content = self._answer()
        self.send_response(code)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(content)))
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(content)

    do_HEAD = do_GET  # noqa: N815 - named by the base class

    def _answer(self) -> tuple[HTTPStatus, str, bytes]:
        """Return the code, the type and the content of the page that is asked for."""
        page, status = self.path.partition("?")[0], self.server.status
        if page == "/metrics":
            from prometheus_client.exposition import choose_encoder  # noqa: PLC0415 - an extra

            encode, kind = choose_encoder(self.headers.get("Accept", ""))
            return HTTPStatus.OK, kind, encode(self.server.registry)
        checks = {"/livez": status.find_hang, "/readyz": status.find_obstacle}
        if page not in checks:
            return HTTPStatus.NOT_FOUND, _PLAIN, b"pages: /metrics /livez /readyz\n"
        if reason := checks[page]():
            return HTTPStatus.SERVICE_UNAVAILABLE, _PLAIN, f"{reason}\n".encode()
        role = describe_role(status.snapshot) if page == "/readyz" and status.snapshot else ""
        return HTTPStatus.OK, _PLAIN, f"ok{role and f', {role}'}\n".encode()

    def log_message(self, format: str, *args: Any) -> None:  # noqa: A002 - named by the base class
        """Write no line for each request."""
