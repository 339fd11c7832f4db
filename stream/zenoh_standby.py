"""Hot standby: several consumers take everything in, and one of them publishes.

Each consumer holds a Zenoh liveliness token `{prefix}socast/consumers/{ticket}-{zid}` and watches those of the others.
The consumers of a shard have a space of their own, `{prefix}socast/consumers/2-of-4/`, and elect one of them.
Its ticket is one above the highest that it has seen. The consumer with the lowest token is the active one; it
publishes and answers queries. The rule needs no system clock, and a consumer that joins later never takes over from one
that is there.

Notes
-----
The router removes the tokens of a consumer when its connection closes, which SIGKILL does at once, or when nothing has
come over it for `LEASE_S`. Another consumer takes over `SETTLE_S` later. By then the old one must be silent:

- A thread looks at the tokens every `TICK_S`. If its last look is older than `FENCE_S`, which is less than the lease,
  the process was stopped: it publishes nothing until it has taken a new ticket, which is behind those of the others.
- A consumer that loses its router gives up its ticket too. A connection that the router has closed delivers nothing.
"""

import logging
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from threading import Event, Thread
from typing import Any, Final

import zenoh
from zenoh import handlers

from socast.core.wire.messages import Message
from socast.stream.closeable import Closeable
from socast.stream.idle_keys import IdleKeys
from socast.stream.source import Sink
from socast.stream.structured_log import event_fields
from socast.stream.zenoh_queryable import ZenohQuery, ZenohQueryable
from socast.stream.zenoh_session import Node

LEASE_S: Final = 2.4
"""Time without a sign of life after which the router removes the tokens of a consumer. [s]"""
FENCE_S: Final = 1.5
"""Age of its last look at the tokens from which a consumer publishes nothing; less than 3/4 of the lease. [s]"""
SETTLE_S: Final = 0.3
"""Time for which no lower token may be there before a consumer becomes active. [s]"""
TICK_S: Final = 0.02
"""Time between two looks at the tokens. [s]"""
_WAITING: Final = 1024
_DIGITS: Final = 9  # of a ticket, so that tickets as texts are in the order of their numbers
_LARGEST_TICKET: Final = 900_000_000  # no consumer queues behind a larger one, which would leave too few digits
_log = logging.getLogger("socast.standby")


def read_boot_s() -> float:
    """Return the time since the start of the computer, with the time for which it was suspended. [s]"""
    return time.clock_gettime(time.CLOCK_BOOTTIME)


class Election:
    """Decide whether a consumer is the active one, from the tokens that it sees.

    Parameters
    ----------
    name : str
        Identifier of the consumer, different from those of the others.
    declare : callable
        Function that replaces the consumer's token by one with the given name.
    clock : callable
        Function that returns monotonic time. [s]

    Attributes
    ----------
    token : str
        Name of the consumer's token; empty before it has one.
    takeovers : int
        Number of times that the consumer became active.
    """

    def __init__(self, name: str, declare: Callable[[str], None], clock: Callable[[], float] = read_boot_s) -> None:
        self.token = ""
        self.takeovers = 0
        self._name, self._declare, self._clock = name, declare, clock
        self._others: set[str] = set()
        self._highest = 0
        self._active = False
        self._looked_s = self._waits_since_s = clock()

    @property
    def is_active(self) -> bool:
        """Return whether the consumer may publish now."""
        is_fresh = self._clock() - self._looked_s < FENCE_S  # first, because a look that ends a pause sets both
        return is_fresh and self._active

    def look(self, events: Sequence[tuple[str, bool]], *, has_router: bool) -> None:
        """Take in the tokens that came and went, and decide."""
        now = self._clock()
        paused = now - self._looked_s >= FENCE_S
        for token, is_there in events:
            self._take(token, is_there=is_there)
        if paused or not has_router:
            self._waits_since_s = now
            if self._active:
                self._become_passive("stopped" if paused else "no_router")
                self._draw_ticket()
        elif any(other < self.token for other in self._others) and self.token:
            self._waits_since_s = now
            if self._active:
                self._become_passive("lower_token")
        elif now - self._waits_since_s >= SETTLE_S:
            if not self.token:
                self._draw_ticket()
                self._waits_since_s = now
            elif not self._active:
                self._active, self.takeovers = True, self.takeovers + 1
                _log.info("active", extra=event_fields(token=self.token))
        self._looked_s = now

    def _take(self, token: str, *, is_there: bool) -> None:
        """Note a token of another consumer."""
        ticket, _, name = token.partition("-")
        is_ticket = len(ticket) == _DIGITS and ticket.isdecimal() and ticket.isascii()
        if name == self._name or not is_ticket:
            return
        if is_there:
            self._others.add(token)
            if int(ticket) < _LARGEST_TICKET:
                self._highest = max(self._highest, int(ticket))
        else:
            self._others.discard(token)

    def _draw_ticket(self) -> None:
        """Replace the token by one behind all that were seen."""
        self._highest += 1
        self.token = f"{self._highest:0{_DIGITS}d}-{self._name}"
        self._declare(self.token)

    def _become_passive(self, cause: str) -> None:
        """Publish nothing from now on."""
        self._active = False
        _log.warning("passive", extra=event_fields(cause=cause, token=self.token))


class Standby(Closeable):
    """Take part in the election through a Zenoh session.

    Parameters
    ----------
    node : Node
        Session and prefix; its lease should be `LEASE_S`.

    Attributes
    ----------
    failure : str
        Why the consumer has left the election for good; empty while it takes part.
    """

    def __init__(self, node: Node) -> None:
        self.failure = ""
        shard = node.connection.shard
        self._session = node.session
        self._space = f"{node.prefix}socast/consumers/" + (f"{shard.chunk}/" if shard else "")
        channel: Any = handlers.FifoChannel(_WAITING)
        self._token: Any = None
        self._tokens: Any = self._session.liveliness().declare_subscriber(f"{self._space}*", channel, history=True)
        self.election = Election(str(self._session.zid()), self._declare)
        events: Any = handlers.FifoChannel(_WAITING)
        self._links: Any = self._session.info.declare_transport_events_listener(events, history=False)
        self._closing = Event()
        self._thread = Thread(target=self._work, name="standby", daemon=True)
        self._thread.start()

    @property
    def is_active(self) -> bool:
        """Return whether this consumer may publish now."""
        return self._thread.is_alive() and self.election.is_active

    def close(self) -> None:
        """Give up the token; a second call has no effect."""
        self._closing.set()
        self._thread.join()

    def _declare(self, token: str) -> None:
        """Replace the token."""
        self._give_up_token()
        self._token = self._session.liveliness().declare_token(self._space + token)

    def _has_stayed_connected(self) -> bool:
        """Return whether there is a router, and no connection was lost since the last call."""
        was_lost = False
        while (event := self._links.handler.try_recv()) is not None:
            was_lost |= event.kind == zenoh.SampleKind.DELETE
        return bool(self._session.info.routers_zid()) and not was_lost

    def _work(self) -> None:
        """Look at the tokens until closed; a failure leaves the consumer passive and not ready."""
        try:
            while not self._closing.wait(TICK_S):
                events = []
                while (sample := self._tokens.handler.try_recv()) is not None:
                    events.append((str(sample.key_expr)[len(self._space) :], sample.kind == zenoh.SampleKind.PUT))
                self.election.look(events, has_router=self._has_stayed_connected())
        except Exception as error:  # noqa: BLE001 - whatever it is, another consumer must be able to take over
            self.failure = f"left the election for good, restart the service: {error!r}"
            _log.error("passive until restarted", extra=event_fields(token=self.election.token, error=repr(error)))
        finally:
            self._give_up_token()

    def _give_up_token(self) -> None:
        """Undeclare the token, so that another consumer can take over; a closed session holds none."""
        token, self._token = self._token, None
        if token is not None:
            with suppress(zenoh.ZError):
                token.undeclare()


class FencedSink:
    """Pass messages on while this consumer is the active one, and drop them otherwise."""

    def __init__(self, sink: Sink, standby: Standby) -> None:
        self._sink, self._standby = sink, standby

    def put(self, messages: Sequence[Message]) -> None:
        """Pass on each message as long as this consumer is active."""
        for message in messages:
            if not self._standby.is_active:
                return
            self._sink.put([message])

    def close(self) -> None:
        """Close the sink."""
        self._sink.close()


class TakeoverSink:
    """Keep the newest message of each key, and publish all of them when this consumer becomes active.

    The loop calls it after each list of messages.

    Parameters
    ----------
    sink : Sink
        Sink that drops messages while this consumer is passive; its `put` must not wait.
    keys : IdleKeys, optional
        Decides which messages are so old that they are not kept any longer.
    """

    def __init__(self, sink: Sink, standby: Standby, keys: IdleKeys | None = None) -> None:
        self._sink, self._standby, self._keys = sink, standby, keys or IdleKeys()
        self._newest: dict[str, Message] = {}
        self._takeovers = 0

    def put(self, messages: Sequence[Message]) -> None:
        """Keep messages, and pass them on if this consumer is active."""
        self._newest.update((message.key, message) for message in messages)
        for key in self._keys.use([message.key for message in messages]):
            del self._newest[key]
        if self._standby.is_active:
            self._sink.put(messages)

    def __call__(self, _: object) -> None:
        """Publish the newest message of each key once after a takeover."""
        if self._standby.is_active and (count := self._standby.election.takeovers) != self._takeovers:
            self._takeovers = count
            self._sink.put(list(self._newest.values()))

    def close(self) -> None:
        """Close the sink."""
        self._sink.close()


class StandbyQueryable(Closeable):
    """Receive queries while this consumer is active; a passive one is not there for those who ask."""

    def __init__(self, node: Node, standby: Standby) -> None:
        self._node, self._standby = node, standby
        self._queryable: ZenohQueryable | None = None

    def pending(self) -> list[ZenohQuery]:
        """Return the waiting queries, the oldest first."""
        if not self._standby.is_active:
            self.close()
            return []
        if self._queryable is None:
            self._queryable = ZenohQueryable(self._node)
        return self._queryable.pending()

    def close(self) -> None:
        """Receive no more queries."""
        if self._queryable is not None:
            self._queryable.close()
            self._queryable = None
