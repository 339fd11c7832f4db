"""Ask the caches of publishers for what a consumer missed: at its start, and whenever a publisher appears again.

A publisher that numbers its samples keeps the last ones in a cache, and a liveliness token shows that it is there. The
token vanishes when the publisher, the router or a link between them is lost, and comes again afterwards. The consumer
then asks the cache for all that it holds, and the pipeline drops what it has.

Live samples wait for answers at most `HOLD_S` at a time. A publisher whose token comes and goes, as over a poor link,
makes them wait at most `RETURNS` times in `RETURNS_S`; after that its cache is asked once this time is over.

Notes
-----
The module allows for this observed behaviour of zenoh 1.10:

- The history of an advanced subscriber is incomplete. If a live sample of a publisher overtakes the answer of its
  cache, the subscriber drops the answer, because it is older than the live sample, and does not count a miss. After a
  restart of the router this lost 388 of 12,000 samples. The caches are therefore asked by separate queries.
- A token of a publisher comes again before its next sample. If the router itself was away, it may come after it.
"""

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import count
from math import inf, isfinite
from typing import Any, Final

import msgspec
import zenoh
from zenoh import handlers

from socast.core.settings import Limits
from socast.core.wire.arrow_batch import PREFIX, BatchError, read_times
from socast.stream.zenoh_session import Node, format_zenoh_error

ANSWER_S: Final = 10.0
"""Longest wait for the answers of caches. [s]"""
SETTLE_S: Final = 0.2
"""Time for which live samples still wait after the last answer, so that samples in flight take their place. [s]"""
DOUBT_S: Final = 0.1
"""Time after the loss of a publisher within which the loss of the router shows. [s]"""
RETURN_S: Final = 5.0
"""Longest wait for publishers after the return of the router; they try to connect every few seconds. [s]"""
HOLD_S: Final = ANSWER_S + SETTLE_S
"""Longest time for which live samples wait while there is a router; then all are passed on. [s]"""
RETURNS: Final = 4
"""Number of times that the token of a publisher may come within `RETURNS_S` for its cache to be asked at once."""
RETURNS_S: Final = 60.0
"""Time in which the comings of a token are counted. [s]"""
SINGLY: Final = 8
"""Number of publishers that are asked one by one; more are asked together."""
_ANSWERS: Final = 1 << 8
_TOKENS: Final = 1 << 16
_log = logging.getLogger("socast.zenoh")


class CacheHistory:
    """Collect what the caches of publishers hold, while live samples wait.

    Parameters
    ----------
    spaces : sequence of str
        Key expressions of the subscriptions, such as `fleet/**`.
    """

    def __init__(self, node: Node, spaces: Sequence[str]) -> None:
        self.asked = 0
        self._session = node.session
        self._all = [f"{space}/@adv/pub/**" for space in spaces]
        self._open: list[Any] = []
        self._fresh: list[str] = list(self._all)
        self._is_client, self._is_cut_off = bool(node.session.info.routers_zid()), False
        self._gone: dict[str, float] = {}  # key -> time until which it is awaited
        self._returns: dict[str, _Returns] = {}
        self._later: dict[str, float] = {}  # key -> time at which its cache is asked
        self._quiet_from = -inf
        self._began: float | None = None
        channel: Any = handlers.RingChannel
        self._tokens: list[Any] = [
            node.session.liveliness().declare_subscriber(keys, channel(_TOKENS), history=True) for keys in self._all
        ]

    def collect(self, now: float) -> list[Any]:
        """Return the samples that caches have sent since the last call, and ask publishers that have appeared.

        Units: now [s].
        """
        for subscriber in self._tokens:
            tokens, _ = _receive(subscriber.handler)
            self._take_tokens(tokens, now)
        self._watch_link(now)
        self._fresh += _remove_due(self._later, now)
        out: list[Any] = []
        for query in list(self._open):
            replies, ended = _receive(query)
            out += [reply.ok for reply in replies if reply.ok is not None]
            if ended:
                self._open.remove(query)
        if self._fresh and not self._open:
            self._ask()
        if self._fresh or self._open or out:
            self._quiet_from = now
        if self._began is None and (self._gone or self._quiet_from == now):
            self._began = now
        return out

    def is_waiting(self, now: float) -> bool:
        """Return whether answers are under way, so that live samples must wait.

        Units: now [s].
        """
        if self._is_cut_off:
            return True
        if self._began is None:
            return False
        if (self._gone or now - self._quiet_from < SETTLE_S) and now - self._began < HOLD_S:
            return True
        self._began = None
        self._gone.clear()
        return False

    def close(self) -> None:
        """End the watch for publishers; a second call has no effect."""
        while self._tokens:
            self._tokens.pop().undeclare()
        for waiting in (self._fresh, self._open, self._later):
            waiting.clear()

    def _take_tokens(self, tokens: Sequence[Any], now: float) -> None:
        """Note which publishers have appeared, and which have gone while this session may be cut off."""
        for token in tokens:
            key = str(token.key_expr)
            if "/forecast/@adv/" in key:
                continue
            returns = self._returns.get(key)
            if returns is None or now - returns.since_s > RETURNS_S:
                returns = self._note_returns(key, now)
            if token.kind == zenoh.SampleKind.PUT:
                self._gone.pop(key, None)
                returns.number += 1
                if returns.number <= RETURNS:
                    self._fresh.append(key)
                else:
                    self._later[key] = returns.since_s + RETURNS_S
            else:
                self._later.pop(key, None)
                if self._is_client and returns.number <= RETURNS:
                    self._gone[key] = now + DOUBT_S

    def _note_returns(self, key: str, now: float) -> "_Returns":
        """Begin to count the comings of a token; forget tokens that have not come for long, where they are many."""
        if len(self._returns) >= _TOKENS:
            self._returns = {key: each for key, each in self._returns.items() if now - each.since_s <= RETURNS_S}
        if len(self._returns) >= _TOKENS:
            self._returns.clear()
        returns = self._returns[key] = _Returns(now)
        return returns

    def _watch_link(self, now: float) -> None:
        """Wait while the router is away, and afterwards for the publishers that were there before, for `RETURN_S`.

        The first live samples of a publisher that returns with its router may come before its token.
        """
        if not self._gone and not self._is_cut_off:
            return
        has_router = bool(self._session.info.routers_zid())
        if self._is_cut_off and has_router:
            self._fresh += self._all
            self._began = now
            self._gone = dict.fromkeys(self._gone, now + RETURN_S)
        self._is_cut_off = not has_router
        if has_router:
            _remove_due(self._gone, now)

    def _ask(self) -> None:
        """Ask the publishers that have appeared, all in one query if they are many."""
        fresh, self._fresh = list(dict.fromkeys(self._fresh)), []
        if len(fresh) > SINGLY:
            fresh = self._all
        channel: Any = handlers.FifoChannel
        try:
            for selector in fresh:
                self.asked += 1
                query = self._session.get(
                    selector,
                    channel(_ANSWERS),
                    target=zenoh.QueryTarget.ALL,
                    consolidation=zenoh.ConsolidationMode.NONE,
                    accept_replies=zenoh.ReplyKeyExpr.ANY,
                    allowed_destination=zenoh.Locality.REMOTE,
                    timeout=ANSWER_S,
                )
                self._open.append(query)
        except zenoh.ZError as error:
            _log.warning("caches of publishers not asked: %s", format_zenoh_error(error))


@dataclass
class _Returns:
    """Count how often the token of a publisher came since a time. [s]"""

    since_s: float
    number: int = 0


def _remove_due(times: dict[str, float], now: float) -> list[str]:
    """Remove the keys whose time has come, and return them."""
    due = [key for key, moment in times.items() if moment <= now]
    for key in due:
        del times[key]
    return due


class _Sent(msgspec.Struct, gc=False):
    """Hold the only field of a payload by which samples without a timestamp are ordered."""

    time_s: float


_sent = msgspec.json.Decoder(_Sent | list[_Sent]).decode
_MOST_ROWS: Final = Limits().list_samples


def merge_samples(samples: Sequence[Any]) -> list[Any]:
    """Return samples from caches and live ones in the order in which they were published.

    The samples of one publisher are ordered by their numbers. Publishers are merged by the timestamps of their
    sessions, or by the senders' times where a session gives no timestamps.

    Parameters
    ----------
    samples : sequence of zenoh.Sample
        Samples of any keys; the same sample may come more than once, and then the first one is returned.
    """
    publishers: dict[Any, dict[int, Any]] = {}
    arrival = count()
    for sample in samples:
        source = sample.source_info
        whose = (str(sample.key_expr), str(source.source_id) if source is not None else None)
        publishers.setdefault(whose, {}).setdefault(source.source_sn if source is not None else next(arrival), sample)
    timed: list[tuple[float, Any]] = []
    for numbered in publishers.values():
        latest = -inf
        for _, sample in sorted(numbered.items()):
            latest = max(latest, _find_time(sample))
            timed.append((latest, sample))
    timed.sort(key=lambda pair: pair[0])
    return [sample for _, sample in timed]


def _find_time(sample: Any) -> float:
    """Return when a sample was published, in units of 2^-32 s of Unix time; minus infinity if nothing tells."""
    if sample.timestamp is not None:
        return int(str(sample.timestamp).partition("/")[0])
    payload = sample.payload.to_bytes()
    try:
        if payload.startswith(PREFIX):
            time_s = read_times(payload, _MOST_ROWS)[0].item()
            return time_s * 2.0**32 if isfinite(time_s) else -inf
        sent = _sent(payload)
        return (sent[0] if isinstance(sent, list) else sent).time_s * 2.0**32
    except (BatchError, msgspec.MsgspecError, UnicodeDecodeError, IndexError, RecursionError):
        return -inf


def _receive(channel: Any) -> tuple[list[Any], bool]:
    """Return what a channel holds, and whether nothing more can come."""
    out: list[Any] = []
    try:
        while (item := channel.try_recv()) is not None:
            out.append(item)
    except zenoh.ZError:
        return out, True
    return out, False
