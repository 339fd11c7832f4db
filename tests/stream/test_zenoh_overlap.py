"""Consumers that publish for the same cars find each other, warn, and say when it is over."""

import logging
from contextlib import ExitStack

import pytest

from socast.core.wire.shard import Shard
from socast.stream.zenoh_overlap import GRACE_S, REPEAT_S, Overlaps, OverlapWatch, Share, name_token, read_token
from socast.stream.zenoh_session import Connection, Node
from tests.support.service import Clock
from tests.support.zenoh_sessions import eventually, router

HALF, OTHER_HALF, THIRD = (Share(Shard(*each), standby=False) for each in ((1, 2), (2, 2), (3, 3)))


@pytest.fixture
def clock():
    return Clock()


@pytest.fixture
def warnings(caplog, monkeypatch):
    monkeypatch.setattr(logging.getLogger("socast"), "propagate", True)
    caplog.set_level(logging.INFO)
    return caplog


@pytest.mark.parametrize(
    ("shard", "standby", "other", "other_standby", "overlap"),
    [
        (Shard(1, 2), False, Shard(2, 2), False, False),
        (Shard(1, 2), False, Shard(3, 3), False, True),
        (Shard(1, 2), False, Shard(1, 2), False, True),
        (Shard(1, 2), True, Shard(1, 2), False, True),
        (Shard(1, 2), True, Shard(1, 2), True, False),
        (Shard(1, 2), True, Shard(2, 3), True, True),
        (Shard(1, 2), False, Shard(2, 2, "chunk"), False, True),
        (Shard(1, 2), False, None, False, True),
        (None, False, None, False, True),
        (None, True, None, True, False),
    ],
)
def test_consumers_overlap_unless_their_shards_differ_within_a_division_or_both_are_on_standby(
    shard, standby, other, other_standby, overlap
):
    one, two = Share(shard, standby), Share(other, other_standby)
    assert one.overlaps(two) == two.overlaps(one) == overlap


@pytest.mark.parametrize("share", [HALF, Share(Shard(7, 100, "chunk"), standby=True), Share(None, standby=False)])
def test_a_token_is_read_as_it_was_named(share):
    assert read_token(name_token(share, "ab12")) == (share, "ab12")


@pytest.mark.parametrize(
    "token", ["", "all", "all/alone-", "name-1-of-2/alone-x", "name-/alone-a", f"all/alone-{'a' * 99}"]
)
def test_a_token_of_another_form_is_ignored(token):
    assert read_token(token) is None


def test_an_overlap_is_logged_with_both_shards_after_the_lease_and_again_while_it_stays(clock, warnings):
    overlaps = Overlaps(HALF, "aa", clock)
    overlaps.look([(name_token(share, zid), True) for share, zid in ((HALF, "aa"), (OTHER_HALF, "bb"), (THIRD, "cc"))])
    assert overlaps.found == ()
    clock.now += GRACE_S
    overlaps.look([])
    overlaps.look([])
    assert overlaps.found == ("shard 3/3",)
    (line,) = warnings.records
    assert "same N in --shard I/N" in line.message
    assert line.fields == {"own": "shard 1/2", "others": "shard 3/3"}
    clock.now += REPEAT_S
    overlaps.look([])
    assert len(warnings.records) == 2


def test_the_end_of_an_overlap_is_logged(clock, warnings):
    overlaps = Overlaps(HALF, "aa", clock)
    overlaps.look([(name_token(THIRD, "cc"), True)])
    clock.now += GRACE_S
    overlaps.look([])
    overlaps.look([(name_token(THIRD, "cc"), False)])
    overlaps.look([])
    assert overlaps.found == ()
    assert [line.levelname for line in warnings.records] == ["WARNING", "INFO"]


def test_a_consumer_that_is_gone_within_the_lease_is_no_overlap(clock, warnings):
    overlaps = Overlaps(HALF, "aa", clock)
    overlaps.look([(name_token(HALF, "bb"), True)])
    overlaps.look([(name_token(HALF, "bb"), False)])
    clock.now += GRACE_S
    overlaps.look([])
    assert not warnings.records


def test_consumers_at_one_router_find_each_other_and_see_when_one_ends():
    clock = Clock()
    with ExitStack() as ending:
        _, endpoint = ending.enter_context(router())

        def join(shard: Shard) -> OverlapWatch:
            node = ending.enter_context(Node(Connection(connect=(endpoint,), shard=shard)))
            return ending.enter_context(OverlapWatch(node, standby=False, clock=clock))

        first, second, other = join(Shard(1, 2)), join(Shard(2, 2)), join(Shard(3, 3))

        def look(watch: OverlapWatch) -> tuple[str, ...]:
            clock.now += GRACE_S
            watch(None)
            return watch.found

        assert eventually(lambda: look(other) == ("shard 1/2", "shard 2/2"))
        assert eventually(lambda: look(first) == look(second) == ("shard 3/3",))
        other.close()
        assert eventually(lambda: look(first) == look(second) == ())
