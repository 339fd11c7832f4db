"""Hot standby: one of two consumers publishes, and the other takes over."""

import signal
from typing import Any

import pytest
from zenoh import SampleKind
from zenoh.handlers import FifoChannel

from socast.core.wire.messages import Message
from socast.stream.idle_keys import IdleKeys
from socast.stream.zenoh_session import Connection, Node
from socast.stream.zenoh_standby import FENCE_S, LEASE_S, SETTLE_S, Election, FencedSink, Standby, TakeoverSink
from tests.support.commands import refused
from tests.support.takeovers import Takeovers
from tests.support.zenoh_sessions import eventually, router

pytestmark = pytest.mark.long


class Clock:
    """A clock that a test moves."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


class Member:
    """A consumer in an election, with its clock."""

    def __init__(self, name: str) -> None:
        self.clock, self.declared = Clock(), []
        self.election = Election(name, self.declared.append, self.clock)

    def look(self, *events: tuple[str, bool], has_router: bool = True, times: int = 1) -> None:
        for _ in range(times):
            self.clock.now += SETTLE_S + 0.01
            self.election.look(events, has_router=has_router)
            events = ()


class Role:
    """A standby whose state a test sets."""

    def __init__(self, member: Member) -> None:
        self.election = member.election

    @property
    def is_active(self) -> bool:
        return self.election.is_active


class Kept(list):
    """A sink that keeps what it gets."""

    def put(self, messages) -> None:
        self.extend(messages)

    def close(self) -> None:
        self.clear()


def test_a_consumer_alone_becomes_active_after_it_has_looked_twice():
    member = Member("a")
    member.look()
    assert not member.election.is_active
    member.look()
    assert member.election.is_active
    assert member.declared == ["000000001-a"]


def test_a_newcomer_waits_until_the_token_of_the_active_one_is_gone():
    member = Member("a")
    member.look(("000000007-b", True), times=5)
    assert member.declared == ["000000008-a"]
    assert not member.election.is_active
    member.look(("000000007-b", False))
    assert member.election.is_active


def test_a_consumer_that_was_stopped_is_passive_before_it_looks_and_queues_behind_the_others():
    member = Member("a")
    member.look(times=2)
    member.look(("000000002-b", True))
    member.clock.now += FENCE_S
    assert not member.election.is_active
    member.look()
    assert member.election.token == "000000003-a"
    member.look(times=3)
    assert not member.election.is_active


def test_a_consumer_without_a_router_is_passive_and_queues_behind_the_others():
    member = Member("a")
    member.look(times=2)
    member.look(("000000002-b", True), has_router=False)
    assert not member.election.is_active
    assert member.election.token == "000000003-a"


def test_the_lower_token_wins_where_two_are_active():
    member = Member("b")
    member.look(times=2)
    member.look(("000000001-a", True))
    assert not member.election.is_active


def test_a_token_that_is_none_is_ignored():
    member = Member("a")
    member.look(
        ("x", True), ("-1-b", True), ("000000000-a", True), ("999999999-b", True), (f"{'9' * 5000}-b", True), times=2
    )
    assert member.election.is_active


def test_two_consumers_behind_the_largest_ticket_are_never_both_active():
    members = [Member(name) for name in "ab"]
    for member in members:
        member.look(("899999999-z", True), times=2)
        member.look(("899999999-z", False))
    tokens = [member.election.token for member in members]
    for member, other in zip(members, reversed(tokens), strict=True):
        member.look((other, True), times=2)
    assert sum(member.election.is_active for member in members) == 1


def test_the_fence_closes_before_the_router_removes_a_token():
    assert LEASE_S * 3 / 4 > FENCE_S


def test_a_takeover_publishes_the_newest_message_of_each_key_once():
    member, kept = Member("a"), Kept()
    role = Role(member)
    sink = TakeoverSink(FencedSink(kept, role), role)
    old, new, other = Message("x", b"1", 0), Message("x", b"2", 0), Message("y", b"3", 0)
    sink.put([old, other])
    sink.put([new])
    sink(None)
    assert not kept
    member.look(times=2)
    sink(None)
    sink(None)
    assert kept == [new, other]


def test_a_takeover_does_not_publish_what_was_not_renewed_for_long():
    member, kept, clock = Member("a"), Kept(), Clock()
    role = Role(member)
    sink = TakeoverSink(FencedSink(kept, role), role, IdleKeys(10.0, clock))
    old, new = Message("x", b"1", 0), Message("y", b"2", 0)
    sink.put([old])
    clock.now += 10.1
    sink.put([new])
    member.look(times=2)
    sink(None)
    assert kept == [new]


def test_a_consumer_whose_election_fails_gives_up_its_token_and_says_why(monkeypatch):
    with router() as (node, endpoint), Node(Connection(connect=(endpoint,))) as client, Standby(client) as standby:
        watched: Any = node.session.liveliness().declare_subscriber("socast/consumers/*", FifoChannel(16), history=True)
        assert eventually(lambda: standby.is_active)

        def fail(*_: Any, **__: Any) -> None:
            raise RuntimeError("broken")

        monkeypatch.setattr(standby.election, "look", fail)
        assert eventually(lambda: standby.failure)
        assert "broken" in standby.failure
        assert eventually(lambda: not standby.is_active)
        assert watched.handler.recv().kind == SampleKind.PUT
        assert watched.handler.recv().kind == SampleKind.DELETE


def test_standby_needs_a_router_of_its_own(capsys):
    assert "give --connect or --config" in refused(capsys, "live", "--standby")


def test_the_other_consumer_takes_over_and_every_forecast_is_that_of_an_uninterrupted_run(tmp_path):
    pair = Takeovers(tmp_path)
    try:
        assert eventually(lambda: sorted(pair.ask_roles()) == ["ok, on standby\n", "ok, publishes\n"])
        pair.interrupt(signal.SIGSTOP)
        pair.interrupt(signal.SIGKILL)
        lost = pair.end()
    finally:
        pair.close()
    assert lost == [0]
    assert pair.forecasts
    assert pair.count_different() == 0
