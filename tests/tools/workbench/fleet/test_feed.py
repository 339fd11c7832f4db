"""The socket of the fleet sends the newest frame to everybody, and survives what is sent to it."""

import asyncio
import json
import random
import socket
import struct
from collections import deque
from contextlib import contextmanager

import numpy as np
import pytest
from websockets.exceptions import ConnectionClosedError, InvalidStatus
from websockets.sync.client import connect

from socast.tools.bench.workbench import BoardSource, make_fleet_messages
from socast.tools.workbench.fleet import feed as feed_module
from socast.tools.workbench.fleet.board import Board
from socast.tools.workbench.fleet.feed import FleetFeed
from socast.tools.workbench.fleet.frames import HEAD
from socast.tools.workbench.jobs import Jobs
from socast.tools.workbench.json_routes import Workbench
from socast.tools.workbench.workspace import Workspace
from tests.support.web_requests import Client
from tests.support.workbenches import serve

MALFORMED = 10_000


@pytest.fixture(scope="module")
def board():
    board = Board()
    board.take(make_fleet_messages(20, 0.0, np.random.default_rng(7)))
    return board


@pytest.fixture(scope="module")
def server(board):
    with serve(Workbench(Workspace(), Jobs(), fleet=BoardSource(board))) as server:
        yield server


@pytest.fixture(scope="module")
def client(server):
    return Client(server)


@contextmanager
def listening(client, **changes):
    """Open the socket of the fleet with the headers of a page, or with changed ones."""
    headers = client.headers(**changes)
    origin, headers = headers.pop("Origin", None), {name: headers[name] for name in ("Cookie",) if name in headers}
    address = f"ws://127.0.0.1:{client.server.port}/fleet.socket"
    with connect(address, origin=origin, additional_headers=headers, open_timeout=5, proxy=None) as opened:
        yield opened


def read_until_frame(opened):
    """Return the notes and the first frame that come."""
    notes = {}
    while isinstance(received := opened.recv(timeout=5), str):
        notes |= json.loads(received)
    return notes, received


def test_browser_receives_columns_names_and_values(client):
    with listening(client) as opened:
        notes, frame = read_until_frame(opened)
    assert notes["cars"] == {"epoch": 0, "begin": 0, "names": [f"taxi-{i:04d}" for i in range(20)]}
    assert notes["source"]["mode"] == "live"
    assert notes["alarms"]["total"] > 0
    assert HEAD.unpack_from(frame)[0] == 20
    assert len(frame) < 2000


@pytest.mark.parametrize("changes", [{"cookie": ""}, {"origin": None}, {"origin": "http://evil.example"}])
def test_socket_is_refused_to_strangers(client, changes):
    with pytest.raises(InvalidStatus) as refused, listening(client, **changes):
        pass
    assert refused.value.response.status_code == 403


def test_browser_that_sends_something_is_disconnected(client):
    with listening(client) as opened:
        opened.send("hello")
        with pytest.raises(ConnectionClosedError) as closed:
            deque(opened, maxlen=0)
    assert closed.value.rcvd.code == 1003


def handshake(client):
    """Return a raw connection that was upgraded to a WebSocket."""
    raw = socket.create_connection(("127.0.0.1", client.server.port), timeout=5)
    headers = client.headers() | {
        "Connection": "Upgrade",
        "Upgrade": "websocket",
        "Sec-WebSocket-Version": "13",
        "Sec-WebSocket-Key": "dGhlIHNhbXBsZSBub25jZQ==",
    }
    lines = "".join(f"{name}: {value}\r\n" for name, value in headers.items())
    raw.sendall(f"GET /fleet.socket HTTP/1.1\r\n{lines}\r\n".encode())
    assert b" 101 " in raw.recv(4096)
    return raw


def make_malformed_frame(draw):
    """Return bytes that are no frame of a browser: reserved bits, unmasked, oversized, cut off, or noise."""
    kind = draw.randrange(5)
    noise = draw.randbytes(draw.randrange(1, 60))
    if kind == 0:
        return bytes([0xF0 | draw.randrange(16), 0x80 | len(noise)]) + noise
    if kind == 1:
        return bytes([0x80 | draw.randrange(16), len(noise)]) + noise
    if kind == 2:
        return bytes([0x82, 0xFF]) + struct.pack(">Q", draw.randrange(1 << 62)) + noise
    if kind == 3:
        return bytes([0x81, 0xFE]) + noise[:2]
    return noise


def test_server_survives_ten_thousand_malformed_frames(client):
    draw = random.Random(7)
    each = 50
    for _ in range(MALFORMED // each):
        with handshake(client) as raw:
            try:
                raw.sendall(b"".join(make_malformed_frame(draw) for _ in range(each)))
            except OSError:
                continue  # the server has closed it already
    assert client.get("/api/session").code == 200
    with listening(client) as opened:
        assert HEAD.unpack_from(read_until_frame(opened)[1])[0] == 20


class StalledSocket:
    """A browser that reads only while its gate is open."""

    def __init__(self):
        self.gate, self.left = asyncio.Event(), asyncio.Event()
        self.frames, self.texts = [], []

    async def accept(self):
        pass

    async def send_text(self, text):
        self.texts.append(json.loads(text))

    async def send_bytes(self, frame):
        self.frames.append(HEAD.unpack_from(frame)[2])
        await self.gate.wait()

    async def receive(self):
        await self.left.wait()
        return {"type": "websocket.disconnect"}


async def until(condition):
    """Let other tasks run until something has come true."""
    while not condition():  # noqa: ASYNC110 - the tasks under test give no event
        await asyncio.sleep(0)


def test_slow_browser_skips_frames_and_delays_nobody(monkeypatch):
    monkeypatch.setattr(feed_module, "SHORTEST_S", 0.001)
    board, rng = Board(), np.random.default_rng(7)

    async def run():
        feed, slow, quick = FleetFeed(BoardSource(board)), StalledSocket(), StalledSocket()
        quick.gate.set()
        tasks = [asyncio.create_task(feed.serve(each)) for each in (slow, quick)]
        for second in range(12):
            board.take(make_fleet_messages(5, float(second), rng))
            seen = len(quick.frames)
            await until(lambda seen=seen: len(quick.frames) > seen)
        stalled = list(slow.frames)
        slow.gate.set()
        await until(lambda: len(slow.frames) > len(stalled))
        for each in (slow, quick):
            each.left.set()
        await asyncio.gather(*tasks)
        return stalled, slow.frames, quick.frames

    stalled, slow, quick = asyncio.run(run())
    assert len(stalled) == 1
    assert slow[1] >= quick[11]


def test_no_frame_is_sent_while_nothing_changes(monkeypatch):
    monkeypatch.setattr(feed_module, "SHORTEST_S", 0.0)
    board = Board()
    board.take(make_fleet_messages(5, 0.0, np.random.default_rng(7)))

    async def run():
        feed, browser = FleetFeed(BoardSource(board)), StalledSocket()
        browser.gate.set()
        task = asyncio.create_task(feed.serve(browser))
        await until(lambda: feed._sequence >= 30)
        browser.left.set()
        await task
        return browser.frames

    assert len(asyncio.run(run())) == 1
