"""The workbench answers only its own pages, in browsers that have entered with an unused token."""

import pytest

from socast.tools.workbench.access import HEADERS, MOST_SESSIONS, POLICY, AccessControl, Sessions
from socast.tools.workbench.jobs import Jobs
from socast.tools.workbench.json_routes import Workbench
from socast.tools.workbench.workspace import Workspace
from tests.support.web_requests import Client
from tests.support.workbenches import serve


@pytest.fixture(scope="module")
def printed():
    """Return the list of addresses that the server announced."""
    return []


@pytest.fixture(scope="module")
def server(printed):
    with serve(Workbench(Workspace(), Jobs()), printed.append) as server:
        yield server


@pytest.fixture(scope="module")
def client(server):
    return Client(server)


def test_token_is_used_up_and_a_new_address_is_announced(server, printed):
    before = len(printed)
    path = server.address.removeprefix(server.origin)
    stranger = Client(server, enters=False)
    entered = stranger.get(path)
    assert (entered.code, entered.headers["location"]) == (303, "/")
    again = stranger.get(path)
    assert again.code == 403
    assert b"used before" in again.content
    assert len(printed) == before + 1
    assert printed[-1] == server.address


def test_cookie_is_of_this_origin_and_out_of_reach_of_scripts(server):
    path = server.address.removeprefix(server.origin)
    cookie = Client(server, enters=False).get(path).headers["set-cookie"].lower()
    assert str(server.port) in cookie.partition("=")[0]
    assert all(words in cookie for words in ("httponly", "samesite=strict", "path=/"))


@pytest.mark.parametrize("path", ["/", "/static/shell.js", "/api/session"])
def test_second_user_of_the_machine_without_the_cookie_is_refused(server, client, path):
    assert client.get(path).code == 200
    stranger = Client(server, enters=False)
    assert stranger.get(path).code == 403
    name = client.cookie.partition("=")[0]
    assert client.get(path, cookie=f"{name}=guess").code == 403
    assert b"open the newest address" in stranger.get(path).content


@pytest.mark.parametrize("path", ["/enter", "/enter?token=", "/enter?token=guess", "/enter?token=%ff%00"])
def test_missing_or_wrong_token_is_refused(server, path):
    assert Client(server, enters=False).get(path).code == 403


@pytest.mark.parametrize(
    "changes",
    [
        {"host": "evil.example"},
        {"host": "evil.example:{port}"},
        {"host": "127.0.0.1:1"},
        {"host": None},
        {"host": "127.0.0.1.evil.example:{port}"},
        {"origin": "http://evil.example"},
        {"origin": "null"},
        {"origin": "http://localhost:{port}"},
        {"sec_fetch_site": "cross-site"},
        {"sec_fetch_site": "same-site"},
    ],
)
def test_other_host_or_origin_is_refused_with_the_cookie(server, client, changes):
    given = {name: value and value.format(port=server.port) for name, value in changes.items()}
    assert client.get("/api/session", **given).code in {400, 403}
    assert client.post("/api/jobs/1/cancel", **given).code in {400, 403}


def test_request_that_changes_something_needs_origin_and_json(client):
    assert client.post("/api/jobs/1/cancel").code == 422
    assert client.post("/api/jobs/1/cancel", origin=None).code == 403
    assert client.post("/api/jobs/1/cancel", content_type="text/plain").code == 415
    assert client.post("/api/jobs/1/cancel", b"[1]").code == 400
    assert client.post("/api/jobs/1/cancel", b"{" + b" " * 70_000).code == 413
    assert client.get("/api/jobs/1/cancel").code == 404


def test_read_only_refuses_every_change_in_one_line():
    with serve(Workbench(Workspace(), Jobs(), read_only=True)) as server:
        client = Client(server)
        assert client.get("/api/session").record()["read_only"] is True
        answer = client.post("/api/jobs/1/cancel")
    assert answer.code == 403
    assert answer.record()["error"].startswith("this workbench is read-only")


@pytest.mark.parametrize("path", ["/", "/static/style.css", "/api/session", "/api/nothing", "/enter"])
def test_every_answer_has_the_security_headers(client, path):
    headers = client.get(path).headers
    assert headers["content-security-policy"] == POLICY
    assert "unsafe" not in POLICY
    assert all(headers[name.lower()] == value for name, value in HEADERS.items())
    assert "server" not in headers


@pytest.mark.parametrize(
    "path", ["/static/../access.py", "/static/%2e%2e/access.py", "/static//etc/passwd", "/static/"]
)
def test_only_the_files_of_the_pages_are_served(client, path):
    assert client.get(path).code == 404


@pytest.mark.parametrize(
    ("host", "accepted", "refused"),
    [
        ("127.0.0.1", ["127.0.0.1", "localhost", "[::1]", "127.0.0.2"], ["10.0.0.5", "evil.example", "0.0.0.0"]),
        ("::1", ["[::1]", "localhost"], ["[2001:db8::1]", "evil.example"]),
        ("0.0.0.0", ["10.0.0.5", "127.0.0.1", "localhost"], ["evil.example", "machine"]),
        ("machine", ["machine", "10.0.0.5"], ["evil.example", "localhost"]),
    ],
)
def test_host_header_is_a_name_that_nobody_else_can_bind(host, accepted, refused):
    control = AccessControl(None, Sessions(8137), host, 8137, lambda: None)
    assert all(control._is_our_host(f"{name}:8137") for name in accepted)
    assert not any(control._is_our_host(f"{name}:8137") for name in refused)
    assert not any(control._is_our_host(name) for name in [*accepted, *refused, "", ":8137", "[", "8137"])


def test_oldest_session_ends_when_there_are_too_many():
    sessions = Sessions(8137)
    secrets = [sessions.enter(sessions.token) for _ in range(MOST_SESSIONS + 1)]
    assert [sessions.knows(secret) for secret in secrets] == [False] + [True] * MOST_SESSIONS
    assert sessions.enter("") is None
    assert not sessions.knows("")
