"""The Zenoh queryable for outlooks of a shift, and the function that queries it.

Notes
-----
Observed of zenoh 1.10, and minded here:

- A FIFO channel that is full holds up all that its session receives, telemetry too. Questions wait in a ring: where
  too many do, the oldest is dropped, and ends at once, without an answer, for whoever asked it.
- A question ends for whoever asks when it is dropped, not when it is answered: none is kept.
- An answer is sent as the question was, so that an asker that does not read may hold up whoever answers. Answers are
  sent by a thread of their own; what waits for it is bounded as well.
- A selector has `;` between its parameters: what is told with `&` between arrives as one long value. Both are passed
  on as text.
"""

import logging
from collections.abc import Callable, Mapping
from functools import partial
from queue import SimpleQueue
from threading import Thread
from types import TracebackType
from typing import Any, Final, Self

import msgspec
import zenoh
from zenoh import handlers

from core.errors import AskError, SettingsError
from stream.zenoh_session import Node, format_zenoh_error

WAITING: Final = 256
"""Most queries that wait to be answered, and most answers that wait to be sent; more are dropped."""
CLOSE_S: Final = 1.0
"""How long the last answers are given to be sent. [s]"""
_log = logging.getLogger("socast.zenoh")


class _Refusal(msgspec.Struct):
    """What an error reply holds."""

    error: str


class ZenohQuery:
    """A Zenoh query that waits for its answer.

    Attributes
    ----------
    vehicle : str
        Chunk of its key, not checked.
    parameters : str
        Parameters after the question mark, as text.
    payload : bytes or None
    """

    def __init__(self, query: Any, prefix: str, send: Callable[[Any, Callable[[], None]], None]) -> None:
        self._query, self._send, self._key = query, send, str(query.key_expr)
        self.vehicle = self._key.removeprefix(f"{prefix}fleet/").removesuffix("/outlook")
        self.parameters = str(query.parameters)
        self.payload: bytes | None = None if query.payload is None else query.payload.to_bytes()

    def reply(self, payload: bytes) -> None:
        """Answer with JSON. Only the first answer is sent; none where the sender of the query has gone."""
        self._send(
            self._query, partial(self._query.reply, self._key, payload, encoding=zenoh.Encoding.APPLICATION_JSON)
        )

    def refuse(self, words: str) -> None:
        """Answer with an error reply, `{"error": words}`."""
        told = msgspec.json.encode(_Refusal(words))
        self._send(self._query, partial(self._query.reply_err, told, encoding=zenoh.Encoding.APPLICATION_JSON))


class ZenohQueryable:
    """Receive queries for `{prefix}fleet/*/outlook` and send their answers; a context manager.

    Parameters
    ----------
    node : Node

    Attributes
    ----------
    unsent : int
        Number of answers that could not be sent.
    """

    def __init__(self, node: Node) -> None:
        self.unsent = 0
        self._prefix = node.prefix
        channel: Any = handlers.RingChannel(WAITING)
        self._queryable: Any = node.session.declare_queryable(f"{node.prefix}fleet/*/outlook", channel)
        self._outgoing: SimpleQueue[tuple[Any, Callable[[], None]] | None] = SimpleQueue()
        self._closed = False
        self._thread = Thread(target=self._work, name="answers", daemon=True)
        self._thread.start()

    def pending(self) -> list[ZenohQuery]:
        """Return the queries that wait, the oldest first; at most `WAITING`."""
        out: list[ZenohQuery] = []
        try:
            while len(out) < WAITING and (query := self._queryable.handler.try_recv()) is not None:
                out.append(ZenohQuery(query, self._prefix, self._leave))
        except zenoh.ZError:
            pass  # closed
        return out

    def close(self) -> None:
        """Take no more queries and send the answers that wait. Closing twice does no harm."""
        if self._closed:
            return
        self._closed = True
        self._queryable.undeclare()
        self._outgoing.put(None)
        self._thread.join(CLOSE_S)

    def __enter__(self) -> Self:
        """Return itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close."""
        self.close()

    def _leave(self, query: Any, send: Callable[[], None]) -> None:
        """Leave an answer to be sent."""
        if self._outgoing.qsize() >= WAITING:
            self.unsent += 1
            _log.warning("answer not sent: %d wait, for an asker that does not read", WAITING)
            query.drop()
        else:
            self._outgoing.put((query, send))

    def _work(self) -> None:
        """Send what there is, until closed."""
        while (answer := self._outgoing.get()) is not None:
            query, send = answer
            try:
                with query:
                    send()
            except Exception as error:  # noqa: BLE001 - whatever an answer does, the next one is sent
                self.unsent += 1
                _log.warning("answer not sent: %s", format_zenoh_error(error))
            del answer, query, send


def query_outlook(
    node: Node, vehicle: str, parameters: Mapping[str, str], payload: bytes | None = None, timeout_s: float = 5.0
) -> bytes:
    """Query the consumer that answers for a vehicle, and return its answer.

    Parameters
    ----------
    node : Node
        Its prefix is put before the key.
    vehicle : str
    parameters : mapping of str to str
        As `core.forecast.plan_checks.parse_leg` takes them.
    payload : bytes, optional
        A plan, as `core.forecast.plan_checks.parse_plan` takes it.
    timeout_s : float
        How long to wait. [s]

    Returns
    -------
    bytes
        JSON of a `core.wire.messages.Outlook`.

    Raises
    ------
    AskError
        Where the consumer refuses the query, with its reason.
    SettingsError
        Where no consumer answers, or not in time.
    """
    key = f"{node.prefix}fleet/{vehicle}/outlook"
    refusals: list[str | None] = []
    try:
        for reply in node.session.get(zenoh.Selector(key, dict(parameters)), payload=payload, timeout=timeout_s):
            if reply.ok is not None:
                return bytes(reply.ok.payload.to_bytes())
            if reply.err is not None:
                refusals.append(_words(reply.err.payload.to_bytes()))
    except zenoh.ZError as error:
        raise SettingsError(f"{key} cannot be asked: {format_zenoh_error(error)}; give a plain name") from error
    if words := next(filter(None, refusals), None):
        raise AskError(words, "told")
    if refusals:
        raise SettingsError(f"{key} is not answered within {timeout_s:g} s; ask again, or wait longer")
    raise SettingsError(
        f"nobody answers {key}; start `socast live` at the same router and with the same prefix, "
        f"and ask no more than {WAITING} questions at once"
    )


def _words(payload: bytes) -> str | None:
    """Return what an error reply says; None for one of Zenoh's own, which says that time is up."""
    try:
        return msgspec.json.decode(payload, type=_Refusal).error
    except (msgspec.DecodeError, UnicodeDecodeError):
        return None
