"""Ask the caches of publishers for what a consumer missed: at its start, and whenever a session appears again.

A publisher that numbers its samples keeps the last ones in a cache, and a liveliness token shows that it is there. The
tokens of a session vanish when it, the router or a link between them is lost, and come again afterwards. The consumer
then asks the caches of the session for all that they hold, and the pipeline drops what it has. A further publisher of a
session that is there was never cut off, and is not asked.

At the start and after the return of the router, all live samples wait for answers, at most `HOLD_S`. Otherwise only
those of the session wait that is asked, so that no session holds up another: until its answers have come, at most
`FIRST_S` for the first one, as anybody else may leave the question open. What comes later is passed on late. Sessions
of a key that come and go, as over a poor link, are asked at most `RETURNS` times in `RETURNS_S`; after that the last
one once this time is over. At most `MOST_ASKED` sessions are asked at a time.

Notes
-----
The module allows for this observed behaviour of zenoh 1.10:

- The history of an advanced subscriber is incomplete. If a live sample of a publisher overtakes the answer of its
  cache, the subscriber drops the answer, because it is older than the live sample, and does not count a miss. After a
  restart of the router this lost 388 of 12,000 samples. The caches are therefore asked by separate queries.
- A token of a publisher comes again before its next sample. If the router itself was away, it may come after it.
"""

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
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
FIRST_S: Final = 1.0
"""Longest wait of a session's live samples for the first answer of its caches. [s]"""
SETTLE_S: Final = 0.2
"""Time for which live samples still wait after the last answer, so that samples in flight take their place. [s]"""
DOUBT_S: Final = 0.1
"""Time after the loss of a publisher within which the loss of the router shows. [s]"""
RETURN_S: Final = 5.0
"""Longest wait for publishers after the return of the router; they try to connect every few seconds. [s]"""
HOLD_S: Final = ANSWER_S + SETTLE_S
"""Longest time for which live samples wait while there is a router; then all are passed on. [s]"""
HOLD_BYTES: Final = 1 << 26
"""Size of live samples and answers that may wait for further answers of caches; more end every wait. [B]"""
HOLD_BYTES_EACH: Final = HOLD_BYTES // 4
"""Size of those of one session; more end its wait. [B]"""
RETURNS: Final = 4
"""Number of times that sessions of a key may come within `RETURNS_S` for their caches to be asked at once."""
RETURNS_S: Final = 60.0
"""Time in which the comings of sessions of a key are counted. [s]"""
MOST_ASKED: Final = 64
"""Largest number of sessions that are asked at a time."""
MOST_SESSIONS: Final = 1 << 16
"""Largest number of sessions, and of keys, that are remembered."""
_ANSWERS: Final = 1 << 8
_TOKENS: Final = 1 << 16
_MARK: Final = "/@adv/pub/"  # between the key of a publisher and the identity of its session, in a token
_log = logging.getLogger("socast.zenoh")


@dataclass(eq=False)
class _Session:
    """Hold the publishers of a session that are there, and what waits for the answers of their caches."""

    tokens: set[str] = field(default_factory=set)
    keys: set[str] = field(default_factory=set)
    spaces: set[str] = field(default_factory=set)
    queries: list[Any] = field(default_factory=list)
    asked_s: float = -inf
    quiet_from: float = -inf
    is_holding: bool = False
    has_answered: bool = False
    held: list[Any] = field(default_factory=list)
    answers: list[Any] = field(default_factory=list)
    size: int = 0

    def must_hold(self, now: float) -> bool:
        """Return whether live samples must wait on."""
        if self.size > HOLD_BYTES_EACH or now - self.asked_s >= HOLD_S:
            return False
        if self.has_answered or not self.queries:
            return now - self.quiet_from < SETTLE_S
        return now - self.asked_s < FIRST_S


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
        self._spaces = [f"{space}{_MARK}" for space in spaces]
        self._must_ask_all = True
        self._queries: list[Any] = []  # to all
        self._is_client, self._is_cut_off = bool(node.session.info.routers_zid()), False
        self._gone: dict[str, float] = {}  # token -> time until which it is awaited
        self._sessions: dict[str, _Session] = {}
        self._comings: dict[str, tuple[float, int]] = {}  # key -> since when, and how often, its sessions have come
        self._to_ask: dict[str, tuple[str, float]] = {}  # session, or key -> session, and time from which it is asked
        self._has_answered: set[str] = set()  # sessions, since all were asked
        self._asked: dict[str, _Session] = {}
        self._holding: dict[str, set[str]] = {}  # key -> sessions whose live samples wait
        self._quiet_from = -inf
        self._began: float | None = None  # of the wait for all
        channel: Any = handlers.RingChannel
        self._tokens: list[Any] = [
            node.session.liveliness().declare_subscriber(f"{keys}**", channel(_TOKENS), history=True)
            for keys in self._spaces
        ]

    def collect(self, now: float) -> list[Any]:
        """Return the answers for which all live samples wait, and ask sessions that have appeared.

        Units: now [s].
        """
        for space, subscriber in zip(self._spaces, self._tokens, strict=False):
            tokens, _ = _receive(subscriber.handler)
            self._take_tokens(space, tokens, now)
        self._watch_link(now)
        out, self._queries = _drain(self._queries)
        self._has_answered |= {_find_session(each) for each in out}
        if self._must_ask_all:
            self._must_ask_all = False
            self._to_ask.clear()
            self._has_answered.clear()
            self._began = now
            self._queries = self._ask([f"{space}**" for space in self._spaces])
        if self._queries or out:
            self._quiet_from = now
        self._ask_sessions(now)
        self._read_answers(now)
        return out

    def is_waiting(self, now: float) -> bool:
        """Return whether all live samples must wait.

        Units: now [s].
        """
        if self._is_cut_off:
            return True
        if self._began is None:
            return False
        is_asking = any(each.is_holding for each in self._asked.values())
        if (self._gone or is_asking or now - self._quiet_from < SETTLE_S) and now - self._began < HOLD_S:
            return True
        self._began = None
        return False

    def withhold(self, samples: list[Any], find_text: Callable[[Any], str]) -> list[Any]:
        """Return the live samples that need not wait; the others wait for the caches of their session."""
        if not self._holding:
            return samples
        out: list[Any] = []
        for sample in samples:
            whose = self._holding.get(find_text(sample.key_expr))
            if whose and (name := _find_session(sample)) in whose:
                waiting = self._asked[name]
                waiting.held.append(sample)
                waiting.size += len(sample.payload)
            else:
                out.append(sample)
        return out

    def release(self, now: float, *, everything: bool = False) -> tuple[list[Any], list[Any]]:
        """Return the live samples of sessions that need not wait any longer, and the answers of their caches.

        Units: now [s].
        """
        live: list[Any] = []
        answers: list[Any] = []
        is_full = sum([each.size for each in self._asked.values()]) > HOLD_BYTES
        for name, each in list(self._asked.items()):
            if each.is_holding and (everything or is_full or not each.must_hold(now)):
                self._end_hold(name, each)
            if not each.is_holding:
                live += each.held
                answers += each.answers
                has_ended = everything or not each.queries or now - each.asked_s >= HOLD_S
                if has_ended or each.size > HOLD_BYTES_EACH or is_full:
                    each.queries = []
                    del self._asked[name]
                each.held, each.answers, each.size = [], [], 0
        return live, answers

    def close(self) -> None:
        """End the watch for publishers; a second call has no effect."""
        while self._tokens:
            self._tokens.pop().undeclare()
        self._must_ask_all = False
        self._queries.clear()
        self._to_ask.clear()
        for each in self._asked.values():
            each.queries = []

    def _take_tokens(self, space: str, tokens: Sequence[Any], now: float) -> None:
        """Note which sessions have appeared, and which publishers have gone while this session may be cut off."""
        for token in tokens:
            text = str(token.key_expr)
            key, _, rest = text.partition(_MARK)
            if key.endswith("/forecast"):
                continue
            name = rest.partition("/")[0]
            session = self._sessions.get(name) or self._note_session(name)
            if token.kind == zenoh.SampleKind.PUT:
                self._gone.pop(text, None)
                if not session.tokens:
                    self._note_coming(name, session, key, now)
                session.tokens.add(text)
                session.keys.add(key)
                session.spaces.add(space)
                if session.is_holding:
                    self._holding.setdefault(key, set()).add(name)
            else:
                session.tokens.discard(text)
                if not session.tokens:
                    self._has_answered.discard(name)  # what it publishes while it is away is asked for when it returns
                if self._is_client:
                    self._gone[text] = now + DOUBT_S

    def _note_session(self, name: str) -> _Session:
        """Remember a session; where they are many, forget those that have gone, or else all that are not asked."""
        for may_stay in (True, False):
            if len(self._sessions) >= MOST_SESSIONS:
                kept = {each for each, session in self._sessions.items() if may_stay and session.tokens}
                self._sessions = {each: self._sessions[each] for each in kept} | self._asked
        session = self._sessions[name] = _Session()
        return session

    def _note_coming(self, name: str, session: _Session, key: str, now: float) -> None:
        """Plan when to ask a session that has come; at once unless sessions of its key come too often."""
        if name not in self._asked:
            session.keys, session.spaces = set(), set()
        since, number = self._comings.pop(key, (now, 0))
        since, number = (since, number + 1) if now - since <= RETURNS_S else (now, 1)
        self._comings[key] = since, number
        if number <= RETURNS:
            self._to_ask[name] = name, now
        else:
            self._to_ask[key] = name, since + RETURNS_S
        for bounded in (self._comings, self._to_ask):
            while len(bounded) > MOST_SESSIONS:
                del bounded[next(iter(bounded))]

    def _watch_link(self, now: float) -> None:
        """Wait while the router is away, and afterwards for the publishers that were there before, for `RETURN_S`.

        The first live samples of a publisher that returns with its router may come before its token.
        """
        if not self._gone and not self._is_cut_off:
            return
        has_router = bool(self._session.info.routers_zid())
        if self._is_cut_off and has_router:
            self._must_ask_all = True
            self._gone = dict.fromkeys(self._gone, now + RETURN_S)
        self._is_cut_off = not has_router
        if has_router:
            for token in [token for token, moment in self._gone.items() if moment <= now]:
                del self._gone[token]

    def _ask_sessions(self, now: float) -> None:
        """Ask the caches of sessions that are due, as many as may be asked at a time, once all have answered."""
        if not self._to_ask or self._queries or len(self._asked) >= MOST_ASKED:
            return
        due = [(label, name) for label, (name, moment) in self._to_ask.items() if moment <= now]
        for label, name in due:
            if name in self._asked or len(self._asked) >= MOST_ASKED:
                continue
            del self._to_ask[label]
            session = self._sessions.get(name)
            if session is None or not session.tokens or name in self._has_answered:
                continue
            self._asked[name] = session
            session.asked_s = session.quiet_from = now
            session.is_holding, session.has_answered = True, False
            session.queries = self._ask([f"{space}{name}/**" for space in sorted(session.spaces)])
            for key in session.keys:
                self._holding.setdefault(key, set()).add(name)

    def _read_answers(self, now: float) -> None:
        """Take the answers of the sessions that are asked."""
        for session in self._asked.values():
            found, still = _drain(session.queries)
            if found or len(still) < len(session.queries):
                session.quiet_from = now
            session.queries, session.has_answered = still, session.has_answered or bool(found)
            session.answers += found
            session.size += sum([len(each.payload) for each in found])

    def _end_hold(self, name: str, session: _Session) -> None:
        """Let the live samples of a session wait no longer."""
        session.is_holding = False
        for key in session.keys:
            if whose := self._holding.get(key):
                whose.discard(name)
                if not whose:
                    del self._holding[key]

    def _ask(self, selectors: Sequence[str]) -> list[Any]:
        """Return queries to caches."""
        channel: Any = handlers.FifoChannel
        queries: list[Any] = []
        try:
            for selector in selectors:
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
                queries.append(query)
        except zenoh.ZError as error:
            _log.warning("caches of publishers not asked: %s", format_zenoh_error(error))
        return queries


def _find_session(sample: Any) -> str:
    """Return the session that published a sample; an empty text if nothing tells."""
    source = sample.source_info
    return "" if source is None else str(source.source_id.zid)


def _drain(queries: Sequence[Any]) -> tuple[list[Any], list[Any]]:
    """Return the samples that have come as answers, and the queries to which more may come."""
    out: list[Any] = []
    still: list[Any] = []
    for query in queries:
        replies, has_ended = _receive(query)
        out += [reply.ok for reply in replies if reply.ok is not None]
        still += [] if has_ended else [query]
    return out, still


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
