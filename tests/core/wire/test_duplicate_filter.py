"""A message that is delivered again is dropped, whatever came between, and nothing else is."""

from itertools import pairwise

from hypothesis import given
from hypothesis import strategies as st

from core.batch import Lanes
from core.pipeline import Pipeline
from core.wire.duplicate_filter import LEAST, PER_VEHICLE, DuplicateFilter
from core.wire.messages import Message
from tests.support.faulty_shifts import shift

KEY = "fleet/a/telemetry"


def make_messages(first: int, stop: int, key: str = "fleet/a/telemetry") -> list[Message]:
    return [Message(key, b'{"time_s":%d}' % i, i) for i in range(first, stop)]


@given(numbers=st.lists(st.integers(0, 40), max_size=200), cuts=st.lists(st.integers(0, 200), max_size=5))
def test_each_message_passes_once_however_the_input_is_cut(numbers, cuts):
    messages = [Message("fleet/a/telemetry", b'{"n":%d}' % n, i) for i, n in enumerate(numbers)]
    filter_, out, edges = DuplicateFilter(Lanes()), [], sorted({0, *cuts, len(messages)})
    for start, stop in pairwise(edges):
        out += filter_.select_new(messages[start:stop])
    assert [m.payload for m in out] == list(dict.fromkeys(m.payload for m in messages))
    assert filter_.dropped == len(messages) - len(out)


def test_the_older_half_of_the_memory_is_forgotten_when_the_newer_half_is_full():
    filter_, new, old = DuplicateFilter(Lanes()), set(), set()
    for turn in range(60):
        batch = [Message(KEY, b"%d" % (n * n * 2654435761 % 40_000), 0) for n in range(turn * 900, turn * 900 + 1000)]
        expected = []
        for message in batch:
            if len(new) == LEAST:
                old, new = new, set()
            if message.payload in new or message.payload in old:
                continue
            expected.append(message)
            new.add(message.payload)
        assert list(filter_.select_new(batch)) == expected


def test_state_does_not_depend_on_the_order_of_neighbours():
    messages = make_messages(0, 30_000)
    first, second = DuplicateFilter(Lanes()), DuplicateFilter(Lanes())
    first.select_new(messages)
    for at in range(0, len(messages), 4):
        second.select_new(messages[at : at + 4][::-1])
    assert first.dump() == second.dump()


def test_memory_grows_with_the_fleet():
    lanes = Lanes([f"car-{i}" for i in range(40)])
    filter_ = DuplicateFilter(lanes)
    messages = make_messages(0, 40 * PER_VEHICLE)
    assert len(filter_.select_new(messages)) == len(messages) > LEAST
    assert list(filter_.select_new(messages)) == []


def test_equal_payload_under_another_key_is_another_message():
    filter_ = DuplicateFilter(Lanes())
    assert len(filter_.select_new(make_messages(0, 3) + make_messages(0, 3, "fleet/b/telemetry"))) == 6


def test_restored_filter_remembers():
    first, second = DuplicateFilter(Lanes()), DuplicateFilter(Lanes())
    first.select_new(make_messages(0, 20_000))
    second.load(first.dump())
    assert second.dump() == first.dump()
    assert second.select_new(make_messages(19_990, 20_003)) == make_messages(20_000, 20_003)


def test_list_is_reduced_to_its_new_samples():
    filter_ = DuplicateFilter(Lanes())
    filter_.select_new([Message(KEY, b'{"n":1}', 0)])
    lists = [Message(KEY, b' [ {"n":1}, {"n":2} ,{"n":3}]', 5), Message(KEY, b'[{"n":2}]', 6)]
    assert filter_.select_new(lists) == [Message(KEY, b'[{"n":2},{"n":3}]', 5)]
    assert filter_.dropped == 2
    assert filter_.select_new([Message(KEY, b"[{", 7), Message(KEY, b"[]", 7), Message(KEY, b"", 7)])[2].payload == b""


def test_pipeline_gives_new_messages_to_recorder_before_it_uses_them():
    sent, kept, pipeline = shift(1), [], Pipeline()
    pipeline.take(sent, kept.extend)
    pipeline.take(sent, kept.extend)
    assert [(m.key, m.payload) for m in kept] == list(dict.fromkeys((m.key, m.payload) for m in sent))
    assert pipeline.quality()["duplicates"] == 2 * len(sent) - len(kept)


def test_history_that_is_delivered_again_after_a_restart_changes_nothing():
    sent, whole = shift(2), Pipeline()
    expected = whole.push(sent)
    pipeline, out = Pipeline(), []
    for at in range(0, len(sent), 50):
        snapshot = pipeline.snapshot()
        pipeline = Pipeline()
        pipeline.restore(snapshot)
        out += pipeline.push(sent[max(0, at - 64) : at + 50])
    assert out == expected
    assert pipeline.snapshot() == whole.snapshot()
