"""The caches of publishers are asked at the start and when publishers come back; answers take their place in order."""

import json
import time
from types import SimpleNamespace
from typing import Any

import pytest
import zenoh

from socast.core.wire.arrow_batch import PREFIX
from socast.core.wire.messages import Message
from socast.stream.zenoh_history import (
    ANSWER_S,
    DOUBT_S,
    FIRST_S,
    HOLD_BYTES_EACH,
    HOLD_S,
    MOST_ASKED,
    MOST_GAPS,
    RETURN_S,
    RETURNS,
    RETURNS_S,
    SETTLE_S,
    CacheHistory,
    merge_samples,
)
from socast.stream.zenoh_session import Connection, Node
from socast.stream.zenoh_sink import ZenohSink
from tests.support.batched_recordings import make_batch
from tests.support.fake_caches import Channel, FakeNode, sample
from tests.support.zenoh_sessions import eventually, router

SPACES = ("weather/**", "fleet/**")
AFTER = SETTLE_S + 0.01
CACHES = ["weather/**/@adv/pub/**", "fleet/**/@adv/pub/**"]
STORED = ["weather/**", *(f"fleet/**/{kind}" for kind in ("telemetry", "vehicle", "ride", "plan", "batch"))]
EVERYBODY = [*CACHES, *(f"{keys}?_time=[now(-1h)..]" for keys in STORED)]
CAR = "fleet/a/telemetry/@adv/pub/1/0/_"
OF_CAR = "fleet/**/@adv/pub/1/**"
KEY = "fleet/a/telemetry"


def texts(samples: list[Any]) -> list[bytes]:
    return [each.payload.to_bytes() for each in samples]


def test_samples_of_one_publisher_are_ordered_by_their_numbers():
    samples = [sample(b"%d" % n, number=n, ntp=100 - n) for n in (3, 1, 2)]
    assert texts(merge_samples(samples)) == [b"1", b"2", b"3"]


def test_publishers_are_merged_by_the_stamps_of_their_sessions():
    one = [sample(b"one %d" % n, number=n, ntp=10 * n) for n in range(3)]
    two = [sample(b"two %d" % n, session="2", number=n, ntp=10 * n + 5) for n in range(3)]
    assert texts(merge_samples([*two, *one])) == [b"one 0", b"two 0", b"one 1", b"two 1", b"one 2", b"two 2"]


def test_publishers_without_stamps_are_merged_by_the_times_in_their_payloads():
    one = [sample(json.dumps({"time_s": n}).encode(), number=n) for n in (1, 4)]
    two = [sample(json.dumps([{"time_s": n}]).encode(), key="fleet/b/telemetry", number=n) for n in (2, 3)]
    merged = [json.loads(text) for text in texts(merge_samples([*one, *two]))]
    assert [(each[0] if isinstance(each, list) else each)["time_s"] for each in merged] == [1, 2, 3, 4]


def test_gateways_without_stamps_are_merged_by_the_first_times_in_their_batches():
    one = [sample(make_payload(n), key="fleet/one/batch", number=n) for n in (1, 4)]
    two = [sample(make_payload(n), key="fleet/two/batch", number=n) for n in (2, 3)]
    single = sample(b'{"time_s": 2.5}', number=1)
    broken = sample(PREFIX, key="fleet/three/batch", number=1)
    assert merge_samples([*one, *two, single, broken]) == [broken, one[0], two[0], single, two[1], one[1]]


def make_payload(time_s: float) -> bytes:
    """Return a batch whose first sample is of a time."""
    return make_batch([{"vehicle_id": "a", "time_s": each} for each in (float(time_s), 99.0)]).payload


def test_a_sample_that_came_twice_is_returned_once():
    samples = [sample(b"live", number=7), sample(b"cached", number=7), sample(b"other session", session="2", number=7)]
    assert sorted(texts(merge_samples(samples))) == [b"live", b"other session"]


def test_samples_without_numbers_keep_the_order_of_their_arrival():
    samples = [sample(b"%d" % n) for n in (3, 1, 3)]
    assert merge_samples(samples) == samples


def test_a_clock_that_was_set_back_does_not_move_samples_before_those_that_precede_them():
    one = [sample(b"one %d" % n, number=n, ntp=ntp) for n, ntp in enumerate((50, 10, 60))]
    two = [sample(b"two", session="2", number=0, ntp=55)]
    assert texts(merge_samples([*one, *two])) == [b"one 0", b"one 1", b"two", b"one 2"]


@pytest.mark.parametrize("payload", [b"", b"\xff", b"[]", b"[" * 100_000, b'{"time_s": "x"}'])
def test_a_payload_that_tells_no_time_comes_first_and_raises_nothing(payload):
    merged = merge_samples([sample(b'{"time_s": 1}', number=0), sample(payload, key="fleet/b/telemetry", number=0)])
    assert texts(merged) == [payload, b'{"time_s": 1}']


def start(node: FakeNode) -> CacheHistory:
    """Return a history whose first queries have been answered, at the time 0."""
    history = CacheHistory(node, SPACES)
    history.collect(0.0)
    node.answer()
    history.collect(0.0)
    assert not waits(history, AFTER)
    return history


def waits(history: CacheHistory, now: float) -> bool:
    """Return whether all live samples wait on after a release."""
    history.release(now)
    return history.is_waiting


def test_all_caches_are_asked_at_the_start_while_live_samples_wait():
    node = FakeNode()
    history = CacheHistory(node, SPACES)
    history.collect(0.0)
    assert list(node.asked) == EVERYBODY
    assert waits(history, 0.0)
    cached = sample(b"cached")
    node.answer(cached)
    history.collect(1.0)
    assert history.withhold([live := sample(b"live")], str) == []
    assert history.release(1.0 + SETTLE_S / 2) == ([], []), "samples in flight may still come"
    assert history.is_waiting
    assert history.release(1.0 + AFTER) == ([live], [cached])
    assert not history.is_waiting
    assert history.asked == len(EVERYBODY)


def test_a_session_that_appears_is_asked_alone_and_only_its_live_samples_wait():
    node = FakeNode()
    history = start(node)
    node.tell(CAR, zenoh.SampleKind.PUT)
    node.tell(CAR.replace("telemetry", "ride"), zenoh.SampleKind.PUT)
    history.collect(1.0)
    assert list(node.asked) == [OF_CAR]
    assert not waits(history, 1.0)
    own, of_another, forged = sample(b"own", number=3), sample(b"b", key="fleet/b", number=1), sample(b"c", session="2")
    assert history.withhold([own, of_another, forged], str) == [of_another, forged]
    assert history.release(1.0 + FIRST_S / 2) == ([], [])
    cached = sample(b"cached", number=2)
    node.answer(cached)
    history.collect(1.0)
    assert history.release(1.0 + SETTLE_S / 2) == ([], []), "samples in flight may still come"
    history.collect(1.0 + AFTER)
    assert history.release(1.0 + AFTER) == ([own], [cached])
    assert history.withhold([own], str) == [own]


def test_a_further_publisher_of_a_session_that_is_there_is_not_asked():
    node = FakeNode()
    history = start(node)
    node.tell(CAR, zenoh.SampleKind.PUT)
    history.collect(1.0)
    assert list(node.asked) == [OF_CAR]
    node.answer()
    history.collect(1.0 + AFTER)
    history.release(1.0 + AFTER)
    for number in range(100):
        node.tell(CAR.replace("/a/", f"/{number}/"), zenoh.SampleKind.PUT)
        history.collect(2.0 + number)
    assert not node.asked


def test_a_token_that_is_told_twice_is_asked_once():
    node = FakeNode()
    history = start(node)
    for _ in range(2):
        node.tell(CAR, zenoh.SampleKind.PUT)
    history.collect(1.0)
    assert history.asked == len(EVERYBODY) + 1


def test_only_so_many_sessions_are_asked_at_a_time_and_the_others_follow():
    node = FakeNode()
    history = start(node)
    sessions = [f"fleet/{number}/telemetry/@adv/pub/{number}/0/_" for number in range(MOST_ASKED + 5)]
    for token in sessions:
        node.tell(token, zenoh.SampleKind.PUT)
    history.collect(1.0)
    assert len(node.asked) == MOST_ASKED
    node.answer()
    for now in (1.0, 1.0 + AFTER):
        history.collect(now)
        history.release(now)
    history.collect(2.0)
    assert len(node.asked) == 5


def test_sessions_that_never_answer_under_one_key_take_few_places():
    node = FakeNode()
    history = start(node)
    most = 0
    for tick in range(500):
        now = 1.0 + 0.1 * tick
        node.tell(f"fleet/evil/telemetry/@adv/pub/{tick}/0/_", zenoh.SampleKind.PUT)
        history.collect(now)
        history.release(now)
        assert not waits(history, now)
        assert history.withhold([sample(b"b", number=1)], str)
        most = max(most, len(history._questions))
    assert most <= RETURNS + 1


def test_session_that_sends_too_much_waits_no_longer():
    node = FakeNode()
    history = start(node)
    node.tell(CAR, zenoh.SampleKind.PUT)
    history.collect(1.0)
    large = sample(bytes(HOLD_BYTES_EACH // 2), number=1)
    assert history.withhold([large], str) == []
    assert history.release(1.0) == ([], [])
    assert history.withhold([large, large], str) == []
    assert history.release(1.0)[0] == [large] * 3
    assert history.withhold([large], str) == [large]


def test_publishers_of_forecasts_are_not_asked():
    node = FakeNode()
    history = start(node)
    node.tell("fleet/a/forecast/@adv/pub/1/0/_", zenoh.SampleKind.PUT)
    history.collect(1.0)
    assert not node.asked
    assert not waits(history, 1.0)


def test_a_publisher_that_appears_while_others_answer_is_asked_afterwards():
    node = FakeNode()
    history = CacheHistory(node, SPACES)
    history.collect(0.0)
    node.tell(CAR, zenoh.SampleKind.PUT)
    history.collect(1.0)
    assert list(node.asked) == EVERYBODY
    node.answer()
    history.collect(2.0)
    assert list(node.asked) == [OF_CAR]


def test_session_that_has_answered_with_all_is_not_asked_again():
    node = FakeNode()
    history = CacheHistory(node, SPACES)
    history.collect(0.0)
    node.tell(CAR, zenoh.SampleKind.PUT)
    node.answer(sample(b"cached", number=1))
    history.collect(1.0)
    assert not node.asked


def test_caches_that_do_not_answer_are_not_awaited_forever():
    node = FakeNode()
    history = CacheHistory(node, SPACES)
    history.collect(0.0)
    late = ANSWER_S + AFTER
    history.collect(late)
    assert not waits(history, late)


def test_live_samples_wait_while_the_router_is_away_and_until_its_publishers_are_back():
    node = FakeNode()
    history = start(node)
    node.tell(CAR, zenoh.SampleKind.DELETE)
    node.routers = []
    history.collect(1.0)
    assert waits(history, 1000.0)
    node.routers = ["router"]
    history.collect(2.0)
    assert list(node.asked) == EVERYBODY
    node.answer()
    history.collect(2.0)
    assert waits(history, 2.0 + RETURN_S / 2), "the publisher is not back"
    node.tell(CAR, zenoh.SampleKind.PUT)
    history.collect(3.0)
    node.answer()
    history.collect(3.0)
    history.release(3.0 + AFTER)
    assert not waits(history, 3.0 + AFTER)


def test_a_publisher_that_does_not_come_back_with_the_router_is_not_awaited_forever():
    node = FakeNode()
    history = start(node)
    node.tell(CAR, zenoh.SampleKind.DELETE)
    node.routers = []
    history.collect(1.0)
    node.routers = ["router"]
    history.collect(2.0)
    node.answer()
    late = 2.0 + RETURN_S + 0.1
    history.collect(late)
    assert not waits(history, late + AFTER)


def test_a_publisher_that_goes_alone_is_not_awaited():
    node = FakeNode()
    history = start(node)
    node.tell(CAR, zenoh.SampleKind.DELETE)
    history.collect(1.0)
    assert not waits(history, 1.0)
    node.routers = []
    history.collect(1.0 + DOUBT_S / 2)
    assert waits(history, 1.0 + DOUBT_S / 2), "the router was lost with it"


def test_a_router_does_not_wait_for_a_publisher_that_goes():
    node = FakeNode(is_client=False)
    history = start(node)
    node.tell(CAR, zenoh.SampleKind.DELETE)
    history.collect(1.0)
    assert not waits(history, 1.0)


def test_a_token_that_comes_and_goes_does_not_hold_live_samples_forever():
    node = FakeNode()
    history = start(node)
    were_held: list[bool] = []
    for tick in range(2000):
        now = 1.0 + 0.05 * tick
        node.tell(CAR, zenoh.SampleKind.DELETE if tick % 2 else zenoh.SampleKind.PUT)
        history.collect(now)
        node.answer()
        history.release(now)
        were_held.append(not history.withhold([sample(b"", number=tick)], str))
        assert not waits(history, now)
    assert were_held[0]
    assert sum(were_held) * 0.05 < 4.0
    assert history.asked <= 2 + 2 * (RETURNS + 1)


def test_the_cache_of_a_token_that_came_often_is_asked_later():
    node = FakeNode()
    history = start(node)
    for now in range(RETURNS + 2):
        node.tell(CAR, zenoh.SampleKind.DELETE)
        node.tell(CAR, zenoh.SampleKind.PUT)
        history.collect(1.0 + now)
        node.answer()
        history.collect(1.1 + now)
        history.release(1.5 + now)
    assert history.asked == len(EVERYBODY) + RETURNS
    history.collect(1.0 + RETURNS_S)
    assert history.asked == len(EVERYBODY) + RETURNS + 1


def test_live_samples_of_a_session_whose_caches_never_answer_wait_for_a_limited_time():
    node = FakeNode()
    history = start(node)
    node.tell(CAR, zenoh.SampleKind.PUT)
    history.collect(1.0)
    live = sample(b"", number=1)
    history.withhold([live], str)
    assert history.release(1.0 + 0.99 * FIRST_S) == ([], [])
    assert history.release(1.0 + FIRST_S) == ([live], [])
    assert history.withhold([live], str) == [live]
    late = sample(b"late")
    node.answer(late)
    history.collect(3.0)
    assert history.release(3.0) == ([], [late])


def test_answers_end_the_wait_though_somebody_leaves_the_question_open():
    node = FakeNode()
    history = start(node)
    node.tell(CAR, zenoh.SampleKind.PUT)
    history.collect(1.0)
    live, cached = sample(b"", number=2), sample(b"", number=1)
    history.withhold([live], str)
    node.asked[OF_CAR].append(SimpleNamespace(ok=cached))
    history.collect(1.1)
    assert history.release(1.1 + SETTLE_S / 2) == ([], [])
    assert history.release(1.1 + AFTER) == ([live], [cached])
    history.release(1.0 + HOLD_S)
    assert not history._questions


def test_only_a_publisher_with_a_gap_is_asked_and_waits():
    node = FakeNode()
    history = start(node)
    revealing = sample(b"5", number=5)
    assert history.ask_again(revealing, KEY, 3, 1.0)
    assert list(node.asked) == ["fleet/a/telemetry/@adv/pub/1/0/**?_sn=3.."]
    others = [sample(b"b", key="fleet/b", number=1), sample(b"c", session="2", number=1)]
    assert history.withhold([revealing, *others], str) == others
    missing = [sample(b"3", number=3), sample(b"4", number=4)]
    assert history.release(1.0 + FIRST_S) == ([], [])
    node.answer(*missing)
    history.collect(2.0)
    assert history.release(2.0) == ([revealing], missing)
    assert history.withhold([revealing], str) == [revealing]


def test_the_gap_of_a_stranger_whose_cache_never_answers_holds_up_nobody_after_the_return_of_the_router():
    node = FakeNode()
    history = start(node)
    assert history.ask_again(sample(b"", number=5), KEY, 3, 1.0)
    node.asked.clear()
    node.tell(CAR, zenoh.SampleKind.DELETE)
    node.routers = []
    history.collect(1.0)
    node.routers = ["router"]
    node.tell(CAR, zenoh.SampleKind.PUT)
    history.collect(2.0)
    node.answer()
    history.collect(2.0)
    node.answer()
    history.collect(2.0)
    assert not waits(history, 2.0 + AFTER)


def test_gaps_of_strangers_take_few_places():
    node = FakeNode()
    history = start(node)
    of_one_key = [history.ask_again(sample(b"", session=str(n), number=9), KEY, 1, 1.0) for n in range(20)]
    assert of_one_key == [True] * RETURNS + [False] * (20 - RETURNS)
    assert not history.ask_again(sample(b"", session="0", number=12), KEY, 11, 1.0), "one question at a time"
    many = [history.ask_again(sample(b"", number=9), f"fleet/{n}/ride", 1, 1.0) for n in range(2 * MOST_GAPS)]
    assert sum(many) == MOST_GAPS - RETURNS
    node.tell(CAR, zenoh.SampleKind.PUT)
    history.collect(1.0)
    assert OF_CAR in node.asked, "sessions are asked nevertheless"
    assert history.release(1.0 + ANSWER_S) == ([], [])
    assert not history._holding
    history.release(1.0 + HOLD_S)
    assert not history._questions


def test_a_session_that_appears_while_its_publisher_is_asked_for_a_gap_ends_both_waits():
    node = FakeNode()
    history = start(node)
    assert history.ask_again(sample(b"", number=5), KEY, 3, 1.0)
    node.tell(CAR, zenoh.SampleKind.PUT)
    history.collect(1.0)
    live = sample(b"live", number=6)
    assert history.withhold([live], str) == []
    node.answer()
    history.collect(1.1)
    assert history.release(1.1 + AFTER) == ([live], [])
    assert not history._holding


def test_queries_that_fail_are_logged_and_end_the_wait(monkeypatch, caplog):
    node = FakeNode()
    history = start(node)

    def fail(*_: Any, **__: Any) -> Channel:
        raise zenoh.ZError("session closed")

    monkeypatch.setattr(node, "get", fail)
    node.tell(CAR, zenoh.SampleKind.PUT)
    history.collect(1.0)
    assert not waits(history, 1.0 + AFTER)
    assert "caches of publishers not asked: session closed" in caplog.text


def test_nothing_is_asked_after_the_close():
    node = FakeNode()
    history = start(node)
    history.close()
    history.close()
    assert node.tokens.ended
    history.collect(1.0)
    assert not node.asked
    assert not waits(history, 1.0)


def test_caches_of_real_publishers_answer_in_full_and_a_newcomer_is_asked():
    sent = {car: [b'{"n":%d}' % n for n in range(40)] for car in "ab"}
    got: list[Any] = []
    with router() as (node, endpoint), Node(Connection(connect=(endpoint,))) as client:
        sink = ZenohSink(client)
        sink.put([Message("fleet/a/telemetry", payload, 0) for payload in sent["a"]])
        history = CacheHistory(node, SPACES)

        def has_all(car: str) -> bool:
            now = time.monotonic()
            history.collect(now)
            got.extend(history.release(now)[1])
            payloads = [each.payload.to_bytes() for each in merge_samples(got) if f"/{car}/" in str(each.key_expr)]
            return payloads == sent[car]

        assert eventually(lambda: has_all("a"))
        with Node(Connection(connect=(endpoint,))) as newcomer:
            other = ZenohSink(newcomer)  # its caches live as long as it does
            other.put([Message("fleet/b/telemetry", payload, 0) for payload in sent["b"]])
            assert eventually(lambda: has_all("b"))
        history.close()
