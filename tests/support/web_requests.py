"""Requests to a workbench as a browser or a stranger sends them."""

import http.client
import json
from typing import Any, NamedTuple
from urllib.parse import urlsplit


class Answer(NamedTuple):
    """Hold the answer to a request."""

    code: int
    headers: dict[str, str]
    content: bytes

    def record(self) -> Any:
        """Return the JSON record."""
        return json.loads(self.content)


class Client:
    """A browser without pages: it keeps the cookie, and sends the headers that a test chooses.

    Parameters
    ----------
    server : socast.tools.workbench.server.WorkbenchServer
    enters : bool
        Whether it enters with the server's token first.
    """

    def __init__(self, server: Any, *, enters: bool = True) -> None:
        self.server, self.cookie = server, ""
        if enters:
            answer = self.get(server.address.removeprefix(server.origin))
            assert answer.code == 303, answer
            self.cookie = answer.headers["set-cookie"].partition(";")[0]

    def headers(self, **changes: str | None) -> dict[str, str]:
        """Return the headers of a page of the workbench with changes; None removes a header."""
        usual = {"Host": urlsplit(self.server.origin).netloc, "Origin": self.server.origin, "Cookie": self.cookie}
        given = usual | {name.replace("_", "-").title(): value for name, value in changes.items()}
        return {name: value for name, value in given.items() if value}

    def get(self, path: str, **changes: str | None) -> Answer:
        """Request a path."""
        return self._send("GET", path, None, self.headers(**{"origin": None} | changes))

    def post(self, path: str, body: Any = None, **changes: str | None) -> Answer:
        """Send a JSON object to a path."""
        content = body if isinstance(body, bytes) else json.dumps(body or {}).encode()
        return self._send("POST", path, content, self.headers(**{"content_type": "application/json"} | changes))

    def _send(self, method: str, path: str, body: bytes | None, headers: dict[str, str]) -> Answer:
        """Send a request over a connection of its own, in one piece.

        A server that refuses the head closes the connection. A body that came later would reset it before the answer.
        """
        parts: list[bytes] = []
        connection = http.client.HTTPConnection("127.0.0.1", self.server.port, timeout=10)
        try:
            connection.connect()
            connection.send = parts.append
            connection.putrequest(method, path, skip_host=True, skip_accept_encoding=True)
            for name, value in headers.items():
                connection.putheader(name, value)
            if body is not None:
                connection.putheader("Content-Length", str(len(body)))
            connection.endheaders(body)
            connection.sock.sendall(b"".join(parts))
            answer = connection.getresponse()
            return Answer(answer.status, {name.lower(): value for name, value in answer.getheaders()}, answer.read())
        finally:
            connection.close()
