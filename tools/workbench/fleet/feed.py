"""The socket of the fleet: every browser receives the newest frame, and a slow one skips those in between.

A frame is encoded once for all browsers. Beside frames the socket sends JSON: once the columns, then the names of cars
that are new, the state of the player, the alarms, and why the pages get no newer, each when it changed. It takes
nothing: a browser that sends anything is disconnected.
"""

import asyncio
import logging
from contextlib import suppress
from typing import Final

import msgspec
from starlette.websockets import WebSocket, WebSocketDisconnect

from socast.tools.workbench.fleet.alarms import list_alarms
from socast.tools.workbench.fleet.frames import HEAD, describe_frames, encode_frame
from socast.tools.workbench.fleet.source import FleetSource

MOST_CLIENTS: Final = 64
"""Largest number of browsers at a time."""
CARS_PER_S: Final = 1000.0
"""Number of cars whose values are sent in a second; the time between two frames follows from it."""
SHORTEST_S, LONGEST_S = 0.2, 1.0
_SURPLUS, _FULL = 1003, 1013  # close codes of a WebSocket: data that it does not accept, and try again later
_log = logging.getLogger("socast.workbench")


class FleetFeed:
    """Encode frames while a page is open, and send them."""

    def __init__(self, source: FleetSource) -> None:
        self._board, self._source = source.board, source
        self._clients = self._sequence = 0
        self._frame, self._values = b"", b""
        self._notes: dict[str, bytes] = {}
        self._problem = ""
        self._task: asyncio.Task[None] | None = None
        self._changed = asyncio.Event()

    def find_problem(self) -> str:
        """Return why the pages get no newer; an empty text where they do."""
        return self._problem or str(self._source.describe()["problem"])

    async def serve(self, socket: WebSocket) -> None:
        """Serve a browser until it leaves."""
        await socket.accept()
        if self._clients >= MOST_CLIENTS:
            await socket.close(_FULL, f"{MOST_CLIENTS} pages are open; close one")
            return
        self._clients += 1
        self._source.show()
        if self._task is None or self._task.done():
            self._task = asyncio.create_task(self._encode())
        sender = asyncio.create_task(self._send(socket))
        try:
            if (await socket.receive())["type"] == "websocket.receive":
                await socket.close(_SURPLUS, "this socket takes nothing")
        finally:
            self._clients -= 1
            sender.cancel()
            with suppress(asyncio.CancelledError):
                await sender

    async def _encode(self) -> None:
        """Encode frames at intervals until no page is open."""
        while self._clients:
            self._sequence += 1
            try:
                frame, notes = await asyncio.to_thread(self._make)
                self._problem = ""
            except Exception:  # noqa: BLE001 - pages that are open must not keep old values unseen
                if not self._problem:
                    _log.exception("the pages of the fleet cannot be renewed")
                self._problem = "the pages cannot be renewed, because of a defect; see the log of `socast serve`"
                frame, notes = self._frame, self._notes | {"problem": msgspec.json.encode({"problem": self._problem})}
            if frame[HEAD.size :] != self._values or frame[:8] != self._frame[:8] or notes != self._notes:
                self._frame, self._values, self._notes = frame, frame[HEAD.size :], notes
                changed, self._changed = self._changed, asyncio.Event()
                changed.set()
            await asyncio.sleep(min(max(len(self._board) / CARS_PER_S, SHORTEST_S), LONGEST_S))

    def _make(self) -> tuple[bytes, dict[str, bytes]]:
        """Return a frame and the notes beside it, as JSON by name."""
        state = self._source.describe()
        notes = {"source": state, "alarms": list_alarms(self._board), "problem": state["problem"]}
        return encode_frame(self._board, self._sequence), {
            name: msgspec.json.encode({name: value}) for name, value in notes.items()
        }

    async def _send(self, socket: WebSocket) -> None:
        """Send the newest frame whenever there is one; what came before it is skipped."""
        sent: dict[str, bytes] = {}
        epoch, known, last = -1, 0, b""
        with suppress(WebSocketDisconnect, RuntimeError):  # the browser has left
            await socket.send_text(msgspec.json.encode({"frames": describe_frames()}).decode())
            while True:
                changed, frame, notes = self._changed, self._frame, self._notes
                for name, note in notes.items():
                    if sent.get(name) != note:
                        sent[name] = note
                        await socket.send_text(note.decode())
                if frame and frame is not last:
                    last = frame
                    cars, new_epoch, _, _ = HEAD.unpack_from(frame)
                    known, epoch = (known, epoch) if new_epoch == epoch else (0, new_epoch)
                    if known < cars:
                        names = self._board.vehicle_ids[known:cars]
                        new_cars = {"cars": {"epoch": epoch, "begin": known, "names": names}}
                        await socket.send_text(msgspec.json.encode(new_cars).decode())
                        known = cars
                    await socket.send_bytes(frame)
                await changed.wait()
