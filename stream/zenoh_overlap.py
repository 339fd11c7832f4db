"""Consumers that divide a fleet differently, or serve the same shard twice, are found by their Zenoh liveliness tokens.

Each consumer holds a token `{prefix}socast/divisions/{share}/{role}-{zid}` and watches those of the others. The share
is `all`, or a division and a shard of it such as `name-2-of-4`. The role is `standby` or `alone`. Two consumers overlap
unless they serve different shards of one division, or the same share and both are on `--standby`.

Notes
-----
The router removes the token of a consumer whose network has failed only after its lease (10 s by default). A consumer
that was restarted elsewhere may see its own old token until then, so an overlap counts only after `GRACE_S`. The watch
looks in the thread of the loop; Zenoh's liveliness `get` misses tokens, so that it subscribes with history instead.
"""

import logging
import re
import time
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any, Final, NamedTuple

import zenoh

from socast.core.wire.shard import Shard
from socast.stream.closeable import Closeable
from socast.stream.structured_log import event_fields
from socast.stream.zenoh_session import Node

GRACE_S: Final = 15.0
"""Time for which another consumer must overlap before it counts; longer than the lease of a session. [s]"""
REPEAT_S: Final = 600.0
"""Time after which the warning on an overlap that stays is repeated. [s]"""
LOOK_S: Final = 1.0
"""Time between two looks at the tokens. [s]"""
_SPACE: Final = "socast/divisions/"
_TOKEN: Final = re.compile(r"(all|(name|chunk)-(\d{1,3})-of-(\d{1,3}))/(standby|alone)-([0-9a-f]{1,32})", re.ASCII)
_REMEDY: Final = (
    "several consumers publish for the same cars: give all of them the same N in --shard I/N and the same --shard-by, "
    "give --standby to consumers of the same cars, and stop the others"
)
_log = logging.getLogger("socast.shards")


class Share(NamedTuple):
    """Describe what a consumer announces: its shard, and whether it publishes only while no other one does."""

    shard: Shard | None
    standby: bool

    def __str__(self) -> str:
        shard = self.shard
        words = "all cars" if shard is None else f"shard {shard}" + (" by chunk" if shard.by == "chunk" else "")
        return f"{words} on standby" if self.standby else words

    def overlaps(self, other: "Share") -> bool:
        """Return whether both may publish for the same cars.

        Examples
        --------
        >>> one = Share(Shard(1, 2), standby=False)
        >>> one.overlaps(Share(Shard(2, 2), standby=False)), one.overlaps(Share(Shard(3, 3), standby=False))
        (False, True)
        """
        if self.shard == other.shard:
            return not (self.standby and other.standby)
        if self.shard is None or other.shard is None:
            return True
        return (self.shard.count, self.shard.by) != (other.shard.count, other.shard.by)


def name_token(share: Share, zid: str) -> str:
    """Return the token of a consumer behind `{prefix}socast/divisions/`.

    Examples
    --------
    >>> name_token(Share(Shard(2, 4), standby=True), "ab12")
    'name-2-of-4/standby-ab12'
    """
    place = "all" if share.shard is None else f"{share.shard.by}-{share.shard.chunk}"
    return f"{place}/{'standby' if share.standby else 'alone'}-{zid}"


def read_token(token: str) -> tuple[Share, str] | None:
    """Return the share and the session of a token; None for a token of another form.

    Examples
    --------
    >>> read_token("name-2-of-4/alone-ab12")
    (Share(shard=Shard(index=2, count=4, by='name'), standby=False), 'ab12')
    """
    if not (found := _TOKEN.fullmatch(token)):
        return None
    by: Any = found[2]
    shard = None if by is None else Shard(int(found[3]), int(found[4]), by)
    return Share(shard, found[5] == "standby"), found[6]


class Overlaps:
    """Find the consumers that overlap with this one, from the tokens that come and go, and warn.

    Parameters
    ----------
    zid : str
        Identifier of the own session, whose token is not that of another consumer.
    clock : callable
        Function that returns monotonic time. [s]

    Attributes
    ----------
    found : tuple of str
        Shares of consumers that have overlapped for `GRACE_S`, sorted.
    """

    def __init__(self, own: Share, zid: str, clock: Callable[[], float] = time.monotonic) -> None:
        self.found: tuple[str, ...] = ()
        self._own, self._zid, self._clock = own, zid, clock
        self._since_s: dict[str, float] = {}
        self._others: dict[str, Share] = {}
        self._warned: tuple[str, ...] = ()
        self._warned_s = 0.0

    def look(self, events: Sequence[tuple[str, bool]]) -> None:
        """Take in the tokens that came and went, and warn where consumers overlap."""
        now = self._clock()
        for token, is_there in events:
            self._take(token, now, is_there=is_there)
        self.found = tuple(
            sorted(str(self._others[token]) for token, since_s in self._since_s.items() if now - since_s >= GRACE_S)
        )
        if self.found and (self.found != self._warned or now - self._warned_s >= REPEAT_S):
            self._warned_s = now
            _log.warning("%s", _REMEDY, extra=event_fields(own=str(self._own), others=", ".join(self.found)))
        elif self._warned and not self.found:
            _log.info("no other consumer serves these cars any more", extra=event_fields(own=str(self._own)))
        self._warned = self.found

    def _take(self, token: str, now: float, *, is_there: bool) -> None:
        """Note a token of another consumer that overlaps."""
        read = read_token(token)
        if read is None or read[1] == self._zid or not self._own.overlaps(read[0]):
            return
        if is_there:
            self._since_s.setdefault(token, now)
            self._others[token] = read[0]
        else:
            self._since_s.pop(token, None)
            self._others.pop(token, None)


class OverlapWatch(Closeable):
    """Announce the share of a consumer, and look for others that overlap, as a watch of the loop.

    Parameters
    ----------
    standby : bool
        Whether the consumer publishes only while no other one of its share does.
    clock : callable
        Function that returns monotonic time. [s]
    """

    def __init__(self, node: Node, *, standby: bool, clock: Callable[[], float] = time.monotonic) -> None:
        own, zid = Share(node.connection.shard, standby), str(node.session.zid())
        self._overlaps, self._clock, self._due_s = Overlaps(own, zid, clock), clock, clock()
        self._space = f"{node.prefix}{_SPACE}"
        self._came: deque[tuple[str, bool]] = deque()
        liveliness = node.session.liveliness()
        self._subscriber: Any = liveliness.declare_subscriber(f"{self._space}**", self._receive, history=True)
        self._token: Any = liveliness.declare_token(self._space + name_token(own, zid))

    @property
    def found(self) -> tuple[str, ...]:
        """Return the shares of other consumers that overlap, sorted."""
        return self._overlaps.found

    def __call__(self, _: object) -> None:
        """Look at the tokens if a look is due."""
        if (now := self._clock()) >= self._due_s:
            self._due_s = now + LOOK_S
            self._overlaps.look([self._came.popleft() for _ in range(len(self._came))])

    def close(self) -> None:
        """Give up the token; a second call has no effect."""
        for held in (self._token, self._subscriber):
            with suppress(zenoh.ZError):  # closed, or undeclared before
                held.undeclare()

    def _receive(self, sample: Any) -> None:
        """Keep a token that came or went, in a thread of Zenoh."""
        self._came.append((str(sample.key_expr)[len(self._space) :], sample.kind == zenoh.SampleKind.PUT))
