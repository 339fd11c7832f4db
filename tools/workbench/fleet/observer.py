"""The observer of a live service: a board of what cars send and the service publishes, and questions to the service."""

import logging
from collections.abc import Mapping
from contextlib import ExitStack
from threading import Event, Thread
from typing import Any, Final

import msgspec

from socast.core.errors import SettingsError
from socast.core.wire.messages import Outlook
from socast.core.wire.plan_checks import parse_leg, parse_vehicle
from socast.stream.zenoh_observer import ZenohObserver
from socast.stream.zenoh_queryable import query_outlook
from socast.stream.zenoh_session import Connection, Node
from socast.tools.workbench.fleet.board import Board

LOOK_S: Final = 0.1
"""Time between two looks for messages. [s]"""
ANSWER_S: Final = 5.0
"""Longest wait for an answer of the service. [s]"""
_log = logging.getLogger("socast.workbench")


class Observer:
    """Show a live service on a board, without publishing anything.

    Parameters
    ----------
    connection : Connection
        How to reach the router of the service.
    """

    def __init__(self, connection: Connection, board: Board) -> None:
        self.board = board
        with ExitStack() as opening:
            self._node = opening.enter_context(Node(connection))
            self._source = ZenohObserver(self._node)
            opening.callback(self._source.close)
            self._closing = opening.pop_all()
        self._endpoints = ", ".join(connection.connect)
        self._stop = Event()
        self._thread = Thread(target=self._run, name="observer", daemon=True)

    def start(self) -> None:
        """Start the thread that takes what arrives."""
        self._thread.start()

    def show(self) -> None:
        """Do nothing: what is live goes on whether anybody looks or not."""

    def close(self) -> None:
        """End the thread and the session."""
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join(10.0)
        self._closing.close()

    def describe(self) -> dict[str, Any]:
        """Return the state of the observer as a JSON record."""
        newest = self.board.newest
        return {
            "mode": "live",
            "endpoint": self._endpoints,
            "time_s": round(newest, 3) if newest == newest else None,  # noqa: PLR0124 - NaN
            "received": sum(self.board.counts.values()),
            "dropped": self._source.dropped,
            "refused": self.board.count_refused(),
            "problem": self._find_problem(),
        }

    def ask(self, vehicle_id: str, parameters: Mapping[str, str]) -> Outlook:
        """Return the outlook on the rest of a car's shift, as `socast ask` does.

        Parameters
        ----------
        parameters : mapping of str to str
            Fields of the ride that the question is about; empty for the shift as planned.
        """
        vehicle = parse_vehicle(vehicle_id)
        parse_leg(parameters)  # report mistakes before a query is sent
        answer = query_outlook(self._node, vehicle, dict(parameters), None, ANSWER_S)
        try:
            return msgspec.json.decode(answer, type=Outlook)
        except (msgspec.DecodeError, UnicodeDecodeError) as error:
            raise SettingsError(
                f"the answer for {vehicle} cannot be read: {error}; use the same version of `socast` as the consumer"
            ) from error

    def list_ask_options(self) -> list[str]:
        """Return the options with which `socast ask` reaches the same service."""
        connection = self._node.connection
        words = [word for each in connection.connect for word in ("--connect", each)]
        words += ["--config", str(connection.config)] if connection.config else []
        return [*words, *(["--prefix", connection.prefix] if connection.prefix else [])]

    def get_parts(self, _: str) -> dict[str, float] | None:
        """Return None: a live service does not publish the energy by term."""
        return None

    def _find_problem(self) -> str:
        """Return why the board gets no newer; an empty text where it does."""
        if not self._thread.is_alive():
            return "nothing is taken any more, because of a defect: see the log, and start `socast serve` again"
        if not self._source.has_router:
            return f"no router at {self._endpoints}; waiting for it"
        return ""

    def _run(self) -> None:
        """Take what arrives until the end; the board itself leaves out what it cannot take."""
        try:
            while not self._stop.wait(LOOK_S):
                self.board.take(self._source.take())
        except Exception:  # noqa: BLE001 - the pages say so
            _log.exception("the observer stopped by a defect")
