"""Half requests, idle connections and slow bodies keep nobody else from the workbench."""

import socket
from contextlib import ExitStack, closing, contextmanager
from http.client import HTTPConnection

import pytest

from socast.tools.workbench import connections, routes
from socast.tools.workbench.connections import MOST_CONNECTIONS, MOST_PER_ADDRESS
from socast.tools.workbench.jobs import Jobs
from socast.tools.workbench.json_routes import Workbench
from socast.tools.workbench.workspace import Workspace
from tests.support.web_requests import Client
from tests.support.workbenches import serve
from tests.support.zenoh_sessions import eventually

WHOLE = b"GET / HTTP/1.1\r\nHost: elsewhere\r\n\r\n"
"""A request that is refused; its connection stays open."""
SENT = {"nothing": b"", "half a head": WHOLE[:20], "whole and half": WHOLE + WHOLE[:20], "idle": WHOLE}
MANY = 300


@pytest.fixture
def client():
    with serve(Workbench(Workspace(), Jobs())) as server:
        yield Client(server)


@contextmanager
def connected(client, count, sent, first_address=1):
    """Hold connections that have sent something, each address of loopback no more than it may."""
    with ExitStack() as held:
        opened = []
        for number in range(count):
            source = (f"127.0.0.{first_address + number // MOST_PER_ADDRESS}", 0)
            each = held.enter_context(socket.create_connection(("127.0.0.1", client.server.port), 5, source))
            each.sendall(sent)
            opened.append(each)
        yield opened


def is_closed(connection):
    """Return whether the server has closed a connection."""
    connection.settimeout(0.01)
    try:
        while received := connection.recv(4096):
            assert received
    except TimeoutError:
        return False
    except ConnectionError:
        pass
    return True


@pytest.mark.parametrize("sent", SENT.values(), ids=SENT)
def test_three_hundred_connections_without_a_whole_request_refuse_nobody(client, sent):
    with connected(client, MANY, sent) as held:
        for _ in range(10):
            assert client.get("/api/session").code == 200
        assert eventually(lambda: sum(map(is_closed, held)) >= MANY - MOST_CONNECTIONS)


def test_one_address_cannot_take_the_places_of_others(client):
    with connected(client, MOST_PER_ADDRESS, SENT["half a head"], 2) as quiet, ExitStack() as held:
        for _ in range(MANY):
            one = held.enter_context(socket.create_connection(("127.0.0.1", client.server.port), 5, ("127.0.0.9", 0)))
            one.sendall(SENT["half a head"])
        assert client.get("/api/session").code == 200
        assert sum(map(is_closed, quiet)) <= MOST_PER_ADDRESS // 10


@pytest.mark.parametrize("sent", SENT.values(), ids=SENT)
def test_connection_that_sends_no_whole_request_is_closed(monkeypatch, client, sent):
    monkeypatch.setattr(connections, "REQUEST_S", 0.3)
    with connected(client, 1, sent) as (one,):
        assert eventually(lambda: is_closed(one), 8.0)


def test_head_that_comes_byte_by_byte_is_not_awaited_forever(monkeypatch, client):
    monkeypatch.setattr(connections, "REQUEST_S", 0.3)
    with connected(client, 1, SENT["half a head"]) as (one,):

        def dribble():
            try:
                one.sendall(b"x")
            except OSError:
                return True
            return is_closed(one)

        assert eventually(dribble, 8.0)


def test_slow_body_is_refused_in_one_line(monkeypatch, client):
    monkeypatch.setattr(routes, "REQUEST_S", 0.3)
    headers = client.headers(content_type="application/json", content_length="10")
    lines = "".join(f"{name}: {value}\r\n" for name, value in headers.items())
    with connected(client, 1, f"POST /api/jobs/x/cancel HTTP/1.1\r\n{lines}\r\n{{".encode()) as (one,):
        assert one.recv(4096).startswith(b"HTTP/1.1 408 ")


def test_connection_that_stays_open_serves_one_request_after_another(client):
    with closing(HTTPConnection("127.0.0.1", client.server.port, timeout=5)) as one:
        for _ in range(3):
            one.request("GET", "/api/session", headers=client.headers(origin=None))
            answer = one.getresponse()
            assert (answer.status, answer.will_close, len(answer.read()) > 0) == (200, False, True)
