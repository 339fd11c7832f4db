"""Ask caches of publishers, and storages, for what a consumer missed: at its start, at a return, and at gaps.

A publisher that numbers its samples keeps the last ones in a cache, and a liveliness token shows that it is there. The
tokens of a session vanish when it, the router or a link between them is lost, and come again afterwards, mostly before
its next sample. The consumer then asks the caches of the session for all that they hold, and the pipeline drops what it
has. A further publisher of a session that is there was never cut off, and is not asked. Where the numbers of a
publisher show a gap, its cache alone is asked, and only from there on. At the start and after the return of the
router, storages are asked for the last hour too; they have no keys with `@`.

At the start and after the return of the router, all live samples wait for answers, at most `HOLD_S`. Otherwise only
those wait whose session or publisher is asked, so that none holds up another: those of a publisher for the end of its
answers, and those of a session at most `FIRST_S` for the first one, as anybody else may leave the question open. What
comes later is passed on late. Sessions of a key that come and go, as over a poor link, are asked at most `RETURNS`
times in `RETURNS_S`; after that the last one once this time is over. At most `MOST_ASKED` sessions and `MOST_GAPS`
publishers are asked at a time.
"""

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import count, islice
from math import inf, isfinite
from typing import Any, Final

import zenoh
from zenoh import handlers

from socast.core.files import UNREADABLE
from socast.core.settings import Limits
from socast.core.wire.arrow_batch import PREFIX, BatchError, read_times
from socast.core.wire.json_scanner import read_time
from socast.core.wire.messages import BATCH, OF_VEHICLES
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
"""Number of times that sessions of a key may come within `RETURNS_S`, and of its publishers that may wait at a time."""
RETURNS_S: Final = 60.0
"""Time in which the comings of sessions of a key are counted. [s]"""
MOST_ASKED: Final = 64
"""Largest number of sessions that are asked at a time."""
MOST_GAPS: Final = 1 << 10
"""Largest number of questions, from which on nobody is asked for a gap."""
MOST_SESSIONS: Final = 1 << 16
"""Largest number of sessions, and of keys, that are remembered."""
_ANSWERS: Final = 1 << 8
_TOKENS: Final = 1 << 16
_ALL: Final = ""
_STORED: Final = [*(kind for kind in OF_VEHICLES if kind != "forecast"), BATCH]  # not `outlook`, which consumers answer
_MARK: Final = "/@adv/pub/"  # between the key of a publisher and the identity of its session, in a token
_log = logging.getLogger("socast.zenoh")


@dataclass(eq=False)
class _Question:
    """Hold what is asked of the caches of a session, or of all, and what waits for their answers."""

    session: str = _ALL
    keys: set[str] = field(default_factory=set)  # whose live samples wait
    queries: list[Any] = field(default_factory=list)
    asked_s: float = inf
    quiet_from: float = inf
    is_exact: bool = False  # whether all is known once the queries have ended
    is_holding: bool = True
    has_answered: bool = False
    held: list[Any] = field(default_factory=list)
    answers: list[Any] = field(default_factory=list)
    size: int = 0

    def hold(self, samples: Sequence[Any]) -> None:
        """Let live samples wait."""
        self.held += samples
        self.size += sum([len(each.payload) for each in samples])


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
        fleets = [space for space in spaces if space.endswith("/**") and "fleet" in space.split("/")]
        kept = [*(set(spaces) - set(fleets)), *(f"{space}/{kind}" for space in fleets for kind in _STORED)]
        self._everybody = [
            *(f"{space}**" for space in self._spaces),
            *(f"{keys}?_time=[now(-1h)..]" for keys in kept),
        ]
        self._must_ask_all = True
        self._is_client, self._is_cut_off = bool(node.session.info.routers_zid()), False
        self._gone: dict[str, float] = {}  # token -> time until which it is awaited
        self._sessions: dict[str, dict[str, str]] = {}  # session -> its tokens, and the space of each
        self._comings: dict[str, tuple[float, int]] = {}  # key -> since when, and how often, its sessions have come
        self._to_ask: dict[str, tuple[str, float]] = {}  # session, or key -> session, and time from which it is asked
        self._has_answered: set[str] = set()  # sessions, since all were asked
        self._questions: dict[str, _Question] = {_ALL: _Question()}
        self._holding: dict[str, dict[str, _Question]] = {}  # key, session -> what its live samples wait for
        channel: Any = handlers.RingChannel
        self._tokens: list[Any] = [
            node.session.liveliness().declare_subscriber(f"{keys}**", channel(_TOKENS), history=True)
            for keys in self._spaces
        ]

    def collect(self, now: float) -> None:
        """Take what has come of tokens and answers, and ask the caches that are due.

        Units: now [s].
        """
        for space, subscriber in zip(self._spaces, self._tokens, strict=False):
            self._take_tokens(space, _receive(subscriber.handler)[0], now)
        self._watch_link(now)
        self._read_answers(now)
        self._ask_all(now)
        self._ask_sessions(now)

    @property
    def is_waiting(self) -> bool:
        """Return whether all live samples wait."""
        return (of_all := self._questions.get(_ALL)) is not None and of_all.is_holding

    def withhold(self, samples: list[Any], find_text: Callable[[Any], str]) -> list[Any]:
        """Return the live samples that need not wait; the others wait for the caches of their session, or of all."""
        if self.is_waiting:
            self._questions[_ALL].hold(samples)
            return []
        if not self._holding:
            return samples
        out: list[Any] = []
        for sample in samples:
            asked = self._holding.get(find_text(sample.key_expr))
            if asked and (question := asked.get(_find_session(sample))):
                question.hold([sample])
            else:
                out.append(sample)
        return out

    def ask_again(self, sample: Any, key: str, first: int, now: float) -> bool:
        """Ask the cache of a sample's publisher from a number on; return whether the sample has to wait."""
        name, number = _find_session(sample), sample.source_info.source_id.eid
        label, waiting = f"{name}/{number}/{key}", self._holding.get(key, {})
        if not self._tokens or label in self._questions or len(waiting) >= RETURNS or len(self._questions) >= MOST_GAPS:
            return False
        queries = self._ask([f"{key}{_MARK}{name}/{number}/**?_sn={first}.."])
        self._begin_hold(label, _Question(name, {key}, queries, now, now, is_exact=True))
        return True

    def release(self, now: float, *, everything: bool = False) -> tuple[list[Any], list[Any]]:
        """Return the live samples that need not wait any longer, and the answers for which they waited.

        Units: now [s].
        """
        must_end = everything or sum([each.size for each in self._questions.values()]) > HOLD_BYTES
        for name in sorted(self._questions, reverse=True):  # all wait for the sessions that are asked
            if (each := self._questions[name]).is_holding and (must_end or not self._must_hold(each, now)):
                self._end_hold(each)
        live: list[Any] = []
        answers: list[Any] = []
        for name, each in [] if self.is_waiting else list(self._questions.items()):
            if not each.is_holding:
                live += each.held
                answers += each.answers
                each.held, each.answers, each.size = [], [], 0
                if everything or not each.queries or now - each.asked_s >= HOLD_S:
                    del self._questions[name]
        return live, answers

    def close(self) -> None:
        """End the watch for publishers; a second call has no effect."""
        while self._tokens:
            self._tokens.pop().undeclare()
        self._must_ask_all = False
        self._to_ask.clear()
        for each in self._questions.values():
            each.queries = []

    def _take_tokens(self, space: str, tokens: Sequence[Any], now: float) -> None:
        """Note which sessions have appeared, and which publishers have gone while this session may be cut off."""
        for token in tokens:
            text = str(token.key_expr)
            key, _, rest = text.partition(_MARK)
            if key.endswith("/forecast"):
                continue
            name = rest.partition("/")[0]
            session = self._note_session(name)
            if token.kind == zenoh.SampleKind.PUT:
                self._gone.pop(text, None)
                if not session:
                    self._note_coming(name, key, now)
                session[text] = space
                if (question := self._questions.get(name)) and question.is_holding:
                    self._hold_key(key, question)
            else:
                session.pop(text, None)
                if not session:
                    self._has_answered.discard(name)  # what it publishes while it is away is asked for when it returns
                if self._is_client:
                    self._gone[text] = now + DOUBT_S

    def _note_session(self, name: str) -> dict[str, str]:
        """Return the tokens of a session; where sessions are many, forget those that have gone, or else all."""
        if name not in self._sessions and len(self._sessions) >= MOST_SESSIONS:
            there = {each: tokens for each, tokens in self._sessions.items() if tokens}
            self._sessions = there if len(there) < MOST_SESSIONS else {}
        return self._sessions.setdefault(name, {})

    def _note_coming(self, name: str, key: str, now: float) -> None:
        """Plan when to ask a session that has come; at once unless sessions of its key come too often."""
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
        """Wait while the router is away, and afterwards for the publishers that were there before, for `RETURN_S`."""
        if not self._gone and not self._is_cut_off:
            return
        was_cut_off, self._is_cut_off = self._is_cut_off, not self._session.info.routers_zid()
        if self._is_cut_off:
            if not was_cut_off:
                self._questions.setdefault(_ALL, _Question()).is_holding = True
            return
        if was_cut_off:
            self._must_ask_all = True
            self._gone = dict.fromkeys(self._gone, now + RETURN_S)
        self._gone = {token: moment for token, moment in self._gone.items() if moment > now}

    def _must_hold(self, question: _Question, now: float) -> bool:
        """Return whether the live samples that wait for answers must wait on."""
        waited_s = now - question.asked_s
        is_done = question.is_exact or now - question.quiet_from >= SETTLE_S
        if question.session == _ALL:
            sessions = [each for each in self._questions.values() if each.session != _ALL and not each.is_exact]
            is_done = is_done and not (question.queries or self._gone or any(each.is_holding for each in sessions))
            return self._is_cut_off or not (is_done or waited_s >= HOLD_S)
        if question.queries and (question.is_exact or not question.has_answered):
            is_done = waited_s >= (ANSWER_S if question.is_exact else FIRST_S)
        return not (is_done or waited_s >= HOLD_S or question.size > HOLD_BYTES_EACH)

    def _ask_all(self, now: float) -> None:
        """Ask the caches of all at the start, and after the return of the router."""
        if self._must_ask_all:
            self._must_ask_all = False
            self._to_ask.clear()
            self._has_answered.clear()
            question = self._questions.setdefault(_ALL, _Question())
            question.is_holding, question.asked_s, question.quiet_from = True, now, now
            question.queries = self._ask(self._everybody)

    def _ask_sessions(self, now: float) -> None:
        """Ask the caches of sessions that are due, as many as may be asked at a time, once all have answered."""
        if not self._to_ask or (_ALL in self._questions and self._questions[_ALL].queries):
            return
        due = [(label, name) for label, (name, moment) in self._to_ask.items() if moment <= now]
        for label, name in due:
            if name in self._questions or sum("/" not in each for each in self._questions) >= MOST_ASKED:
                continue
            del self._to_ask[label]
            if (tokens := self._sessions.get(name)) and name not in self._has_answered:
                queries = self._ask([f"{space}{name}/**" for space in sorted(set(tokens.values()))])
                keys = {token.partition(_MARK)[0] for token in tokens}
                self._begin_hold(name, _Question(name, keys, queries, now, now))

    def _read_answers(self, now: float) -> None:
        """Take the answers to all questions."""
        for question in self._questions.values():
            found, still = _drain(question.queries)
            if found or len(still) < len(question.queries):
                question.quiet_from = now
            question.queries, question.has_answered = still, question.has_answered or bool(found)
            question.answers += found
            question.size += sum([len(each.payload) for each in found])
            if question.session == _ALL:
                self._has_answered |= {_find_session(each) for each in found}

    def _begin_hold(self, label: str, question: _Question) -> None:
        """Let live samples wait for the answers to a question."""
        self._questions[label] = question
        for key in question.keys:
            self._hold_key(key, question)

    def _hold_key(self, key: str, question: _Question) -> None:
        """Let the live samples of a key wait for the answers to a question, unless they wait for others."""
        question.keys.add(key)
        self._holding.setdefault(key, {}).setdefault(question.session, question)

    def _end_hold(self, question: _Question) -> None:
        """Let live samples wait no longer for the answers to a question."""
        question.is_holding = False
        for key in question.keys:
            if (asked := self._holding.get(key, {})).get(question.session) is question:
                del asked[question.session]
            if not asked:
                self._holding.pop(key, None)

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


_MOST_ROWS: Final = Limits().list_samples


def merge_samples(samples: Sequence[Any]) -> list[Any]:
    """Return samples from caches and live ones in the order in which they were published.

    The samples of one publisher are ordered by their numbers; those without, as storages return them, by their
    timestamps. Publishers are merged by the timestamps of their sessions, or by the senders' times where a session
    gives no timestamps.

    Parameters
    ----------
    samples : sequence of zenoh.Sample
        Samples of any keys; the same sample may come more than once, and then the first one is returned.
    """
    publishers: dict[Any, dict[tuple[float, int], Any]] = {}
    arrival = count()
    for sample in samples:
        source = sample.source_info
        whose = (str(sample.key_expr), str(source.source_id) if source is not None else None)
        numbers = (source.source_sn, 0) if source else (_find_time(sample) if sample.timestamp else 0, next(arrival))
        publishers.setdefault(whose, {}).setdefault(numbers, sample)
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
        time_s = float(read_times(payload, _MOST_ROWS)[0]) if payload.startswith(PREFIX) else read_time(payload)
    except (*UNREADABLE, BatchError, IndexError):
        return -inf
    return time_s * 2.0**32 if isfinite(time_s) else -inf


def _receive(channel: Any) -> tuple[list[Any], bool]:
    """Return what a channel holds, and whether nothing more can come."""
    out: list[Any] = []
    try:
        out.extend(islice(iter(channel.try_recv, None), _TOKENS))
    except zenoh.ZError:
        return out, True
    return out, False
