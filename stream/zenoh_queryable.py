"""The Zenoh queryable for the outlook of a shift, and the function that queries it.

Notes
-----
The module allows for this observed behaviour of zenoh 1.10:

- A full FIFO channel blocks everything that its session receives, telemetry included. Queries therefore wait in a ring
  channel. A full ring drops its oldest query, which ends immediately and without an answer for its sender.
- A query ends for its sender when the query object is dropped, not when it is answered. The queryable therefore keeps
  no query object after the answer.
- Zenoh sends an answer in the same way as its query, so a client that does not read may block the sender of the answer.
  A separate thread sends the answers, and the number of answers that wait for it is bounded.
- A selector separates its parameters with `;`, and parameters separated with `&` arrive as one long value. The
  queryable passes on both as text.
"""

import logging
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import partial
from queue import SimpleQueue
from threading import Thread
from typing import Any, Final

import msgspec
import zenoh
from zenoh import handlers

from socast.core.errors import AskError, SettingsError
from socast.core.files import UNREADABLE
from socast.stream.closeable import Closeable
from socast.stream.zenoh_session import Node, format_zenoh_error

WAITING: Final = 256
"""Largest number of queries that wait for an answer, and of answers that wait to be sent; any more are dropped."""
CLOSE_S: Final = 1.0
"""Time given to the last answers to be sent. [s]"""
_log = logging.getLogger("socast.zenoh")


class _Refusal(msgspec.Struct):
    """Hold the content of an error reply."""

    error: str


class ZenohQuery:
    """Hold a Zenoh query that waits for its answer.

    Parameters
    ----------
    prefix : str
        Key chunks before `fleet`, with a slash at the end.
    send : callable
        Function that takes the query and a function that sends its answer.

    Attributes
    ----------
    vehicle : str
        Identifier of the car from the key, without validation.
    parameters : str
        Parameters after the question mark, as text.
    """

    def __init__(self, query: Any, prefix: str, send: Callable[[Any, Callable[[], None]], None]) -> None:
        self._query, self._send, self._key = query, send, str(query.key_expr)
        self.vehicle = self._key.removeprefix(f"{prefix}fleet/").removesuffix("/outlook")
        self.parameters = str(query.parameters)
        self.payload: bytes | None = None if query.payload is None else query.payload.to_bytes()

    def reply(self, payload: bytes) -> None:
        """Answer with JSON. Zenoh sends only the first answer, and none if the sender of the query has gone."""
        self._send(
            self._query, partial(self._query.reply, self._key, payload, encoding=zenoh.Encoding.APPLICATION_JSON)
        )

    def refuse(self, words: str) -> None:
        """Answer with an error reply, `{"error": words}`."""
        payload = msgspec.json.encode(_Refusal(words))
        self._send(self._query, partial(self._query.reply_err, payload, encoding=zenoh.Encoding.APPLICATION_JSON))


class ZenohQueryable(Closeable):
    """Receive queries for `{prefix}fleet/*/outlook`, or those of its shard, and send their answers.

    Attributes
    ----------
    unsent : int
        Number of answers that could not be sent.
    """

    def __init__(self, node: Node) -> None:
        self.unsent = 0
        self._prefix = node.prefix
        self._queryables: list[Any] = [
            node.session.declare_queryable(f"{cars}/outlook", handlers.RingChannel(WAITING))
            for cars in node.list_answered()
        ]
        self._outgoing: SimpleQueue[tuple[Any, Callable[[], None]] | None] = SimpleQueue()
        self._closed = False
        self._thread = Thread(target=self._work, name="answers", daemon=True)
        self._thread.start()

    def pending(self) -> list[ZenohQuery]:
        """Return at most `WAITING` waiting queries, the oldest first."""
        out: list[ZenohQuery] = []
        for queryable in self._queryables:
            with suppress(zenoh.ZError):  # closed
                while len(out) < WAITING and (query := queryable.handler.try_recv()) is not None:
                    out.append(ZenohQuery(query, self._prefix, self._leave))
        return out

    def close(self) -> None:
        """Receive no more queries and send the waiting answers; a second call has no effect."""
        if self._closed:
            return
        self._closed = True
        for queryable in self._queryables:
            queryable.undeclare()
        self._outgoing.put(None)
        self._thread.join(CLOSE_S)

    def _leave(self, query: Any, send: Callable[[], None]) -> None:
        """Queue an answer for sending, or drop it if too many answers wait."""
        if self._outgoing.qsize() >= WAITING:
            self.unsent += 1
            _log.warning("answer not sent: %d answers wait for a client that does not read them", WAITING)
            query.drop()
        else:
            self._outgoing.put((query, send))

    def _work(self) -> None:
        """Send queued answers until the queryable is closed."""
        while (answer := self._outgoing.get()) is not None:
            query, send = answer
            try:
                with query:
                    send()
            except Exception as error:  # noqa: BLE001 - a failed answer must not stop the next ones
                self.unsent += 1
                _log.warning("answer not sent: %s", format_zenoh_error(error))
            del answer, query, send


def query_outlook(
    node: Node, vehicle: str, parameters: Mapping[str, str], payload: bytes | None = None, timeout_s: float = 5.0
) -> bytes:
    """Query the consumer that answers for a vehicle, and return its answer."""
    key = f"{node.prefix}fleet/{vehicle}/outlook"
    refusals: list[str | None] = []
    try:
        for reply in node.session.get(zenoh.Selector(key, dict(parameters)), payload=payload, timeout=timeout_s):
            if reply.ok is not None:
                return bytes(reply.ok.payload.to_bytes())
            if reply.err is not None:
                refusals.append(_read_reason(reply.err.payload.to_bytes()))
    except zenoh.ZError as error:
        raise SettingsError(f"{key} cannot be queried: {format_zenoh_error(error)}; give a plain name") from error
    if words := next(filter(None, refusals), None):
        raise AskError(words, "refused")
    if refusals:
        raise SettingsError(f"{key} is not answered within {timeout_s:g} s; query again, or wait longer")
    raise SettingsError(
        f"no consumer answers {key}; start `socast live` at the same router and with the same prefix; where shards "
        "divide the fleet, the shard of this car may be down"
    )


def _read_reason(payload: bytes) -> str | None:
    """Return the reason in an error reply; None for Zenoh's own reply, which reports a timeout."""
    try:
        return msgspec.json.decode(payload, type=_Refusal).error
    except UNREADABLE:
        return None
