"""A message that is delivered again is dropped, whatever came between, and nothing else is."""

from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from socast.core.batch import Lanes
from socast.core.pipeline import Pipeline
from socast.core.settings import Limits
from socast.core.wire import duplicate_filter
from socast.core.wire.decoder import Refused
from socast.core.wire.duplicate_filter import LEAST, PER_VEHICLE, DuplicateFilter
from socast.core.wire.messages import Message
from tests.support.faulty_shifts import decodable_shift
from tests.support.telemetry import chunked, drive, make_message, observed, telemetry

KEY = "fleet/a/telemetry"


def make_messages(first: int, stop: int, key: str = "fleet/a/telemetry") -> list[Message]:
    return [Message(key, b'{"time_s":%d}' % i, i) for i in range(first, stop)]


def select_all(filter_, messages):
    """Return the messages that are new, as a pipeline does that refuses none."""
    out = []
    while messages:
        new, messages = filter_.select_new(messages)
        out += new
    return out


@given(numbers=st.lists(st.integers(0, 40), max_size=200), cuts=st.lists(st.integers(0, 200), max_size=5))
def test_each_message_passes_once_however_the_input_is_cut(numbers, cuts):
    messages = [Message("fleet/a/telemetry", b'{"n":%d}' % n, i) for i, n in enumerate(numbers)]
    filter_, out, edges = DuplicateFilter(Lanes()), [], sorted({0, *cuts, len(messages)})
    for start, stop in pairwise(edges):
        out += select_all(filter_, messages[start:stop])
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
        assert select_all(filter_, batch) == expected


def test_state_does_not_depend_on_the_order_of_neighbours():
    messages = make_messages(0, 30_000)
    first, second = DuplicateFilter(Lanes()), DuplicateFilter(Lanes())
    select_all(first, messages)
    for at in range(0, len(messages), 4):
        select_all(second, messages[at : at + 4][::-1])
    assert first.dump() == second.dump()


def test_one_large_batch_is_remembered_as_small_ones_are():
    sample = '{{"vehicle_id":"{}","time_s":{},"speed_kmh":0}}'
    messages = [
        Message(f"fleet/{car}/telemetry", sample.format(car, 10**9 + time).encode(), 0)
        for time in range(850)
        for car in "abcdefghijklmnopqrst"
    ]
    assert len(messages) > LEAST
    whole, parts = Pipeline(), Pipeline()
    whole.push(messages)
    for at in range(0, len(messages), 1000):
        parts.take(messages[at : at + 1000])
    assert whole.duplicates.dump() == parts.duplicates.dump()


def test_memory_grows_with_the_fleet():
    lanes = Lanes([f"car-{i}" for i in range(40)])
    filter_ = DuplicateFilter(lanes)
    messages = make_messages(0, 40 * PER_VEHICLE)
    assert len(select_all(filter_, messages)) == len(messages) > LEAST
    assert select_all(filter_, messages) == []


def test_equal_payload_under_another_key_is_another_message():
    filter_ = DuplicateFilter(Lanes())
    assert len(select_all(filter_, make_messages(0, 3) + make_messages(0, 3, "fleet/b/telemetry"))) == 6


def test_restored_filter_remembers():
    first, second = DuplicateFilter(Lanes()), DuplicateFilter(Lanes())
    select_all(first, make_messages(0, 20_000))
    second.load(first.dump())
    assert second.dump() == first.dump()
    assert select_all(second, make_messages(19_990, 20_003)) == make_messages(20_000, 20_003)


def test_list_is_reduced_to_its_new_samples():
    filter_ = DuplicateFilter(Lanes())
    select_all(filter_, [Message(KEY, b'{"n":1}', 0)])
    lists = [Message(KEY, b' [ {"n":1}, {"n":2} ,{"n":3}]', 5), Message(KEY, b'[{"n":2}]', 6)]
    assert select_all(filter_, lists) == [Message(KEY, b'[{"n":2},{"n":3}]', 5)]
    assert filter_.dropped == 2
    assert select_all(filter_, [Message(KEY, b"[{", 7), Message(KEY, b"[]", 7), Message(KEY, b"", 7)])[2].payload == b""


def test_pipeline_gives_new_messages_to_recorder_before_it_uses_them():
    sent, kept, pipeline = decodable_shift(1), [], Pipeline()
    pipeline.take(sent, kept.extend)
    pipeline.take(sent, kept.extend)
    assert [(m.key, m.payload) for m in kept] == list(dict.fromkeys((m.key, m.payload) for m in sent))
    assert pipeline.quality()["duplicates"] == 2 * len(sent) - len(kept)


def test_history_that_is_delivered_again_after_a_restart_changes_nothing():
    sent, whole = decodable_shift(2), Pipeline()
    expected = whole.push(sent)
    pipeline, out = Pipeline(), []
    for at in range(0, len(sent), 50):
        snapshot = pipeline.snapshot()
        pipeline = Pipeline()
        pipeline.restore(snapshot)
        out += pipeline.push(sent[max(0, at - 64) : at + 50])
    assert out == expected
    assert pipeline.snapshot() == whole.snapshot()


def run_in_parts(messages, cuts, limits):
    """Return a pipeline after messages in parts, and its recording."""
    pipeline, recording = Pipeline(limits=limits), []
    for part in chunked(messages, cuts):
        pipeline.take(part, recording.extend)
    return pipeline, recording


def make_mixed_message(kind, number):
    """Return a message of one of few vehicles or stations, or one that cannot be decoded."""
    car, time = "abcdef"[number % 6], 1.7e9 + number
    sample, bad = b'{"vehicle_id":"%s","time_s":%.0f}' % (car.encode(), time), b'{"vehicle_id":%d}' % number
    key = f"fleet/{car}/telemetry"
    match kind:
        case "sample":
            return Message(key, sample, 0)
        case "bad":
            return Message(key, bad, 0)
        case "list":
            return Message(key, b"[" + b",".join([sample, bad, b"[" + sample + b"]"]) + b"]", 0)
        case "long list":
            return Message(key, b"[" + b",".join([sample] * 4) + b"]", 0)
        case "weather":
            return observed(f"station-{number % 4}", time, temperature_c=1.0)
        case "lost weather":
            return observed("lost", time, (99.0, number))
        case "ride":
            return make_message("ride", car, time, ride_id="r", event="start")
        case _:
            return Message(f"strange/{number}", b"{}", 0)


KINDS = "sample", "bad", "list", "long list", "weather", "lost weather", "ride", "unknown"


@given(
    content=st.lists(st.tuples(st.sampled_from(KINDS), st.integers(0, 12)), min_size=1, max_size=60),
    cuts=st.lists(st.integers(0, 60), max_size=6),
)
def test_state_and_recording_are_the_same_for_any_division_whatever_is_refused_and_repeated(content, cuts):
    messages = [make_mixed_message(*each) for each in content]
    limits = Limits(vehicles=3, stations=2, list_samples=3)
    with pytest.MonkeyPatch.context() as patch:  # the halves turn over often
        patch.setattr(duplicate_filter, "LEAST", 4)
        patch.setattr(duplicate_filter, "PER_VEHICLE", 3)
        single, recording = run_in_parts(messages, range(len(messages)), limits)
        parts, other_recording = run_in_parts(messages, cuts, limits)
        replayed, _ = run_in_parts(recording, [], limits)
    assert parts.snapshot() == single.snapshot() == replayed.snapshot()
    assert parts.quality() == single.quality()
    assert sorted(list_samples(other_recording)) == sorted(list_samples(recording))


def list_samples(messages):
    """Return key and bytes of each sample of messages."""
    return [(m.key, bytes(each)) for m in messages for each in DuplicateFilter(Lanes())._split_samples(m)[0]]


def count_remembered(pipeline):
    _, new, old = pipeline.duplicates.dump()
    return (len(new) + len(old)) // 8


def test_only_what_is_taken_in_is_remembered():
    pipeline = Pipeline(limits=Limits(vehicles=5, stations=5))
    for _ in range(2):
        for number in range(2000):
            stranger = Message(f"fleet/s{number}/telemetry", b'{"vehicle_id":"s%d","time_s":1.7e9}' % number, 0)
            junk = Message("fleet/s0/telemetry", b"{%d" % number, 0)
            pipeline.take([stranger, junk, observed(f"station-{number}", temperature_c=1.0)])
    quality = pipeline.quality()
    assert quality["received"] == {"telemetry": 5, "weather": 5}
    assert quality["undecodable"] == {"not_json": 4000, "too_many_stations": 3990, "too_many_vehicles": 3990}
    assert quality["duplicates"] == count_remembered(pipeline) == 10


def test_refused_message_is_counted_and_recorded_each_time_and_pushes_nothing_out_of_the_memory():
    known = Message(KEY, b'{"vehicle_id":"a","time_s":1.7e9}', 0)
    junk = [Message(KEY, b"{%d" % number, 0) for number in range(LEAST)]
    pipeline, recording = Pipeline(), []
    pipeline.take([known, *junk, *junk, *junk, known], recording.extend)
    assert len(recording) == 1 + 3 * LEAST
    assert pipeline.quality()["undecodable"] == {"not_json": 3 * LEAST}
    assert pipeline.quality()["duplicates"] == 1


def test_vehicle_that_was_refused_is_taken_in_once_there_is_room():
    message = Message("fleet/b/telemetry", b'{"vehicle_id":"b","time_s":1.7e9}', 0)
    full = Pipeline(limits=Limits(vehicles=1))
    full.push([*telemetry(drive(5)), message])
    wider = Pipeline(limits=Limits(vehicles=2))
    wider.restore(full.snapshot())
    wider.push([message])
    assert wider.lanes.names == ["a", "b"]


def test_new_vehicle_in_the_batch_in_which_the_halves_turn_over_changes_no_half():
    messages = [
        Message(f"fleet/{car}/telemetry", b'{"vehicle_id":"%s","time_s":%d}' % (car.encode(), 10**9 + time), 0)
        for time in range(LEAST // 8 + 20)
        for car in ("abcdefgh" if time < LEAST // 8 - 1 else "tsrqponmlkjihgfedcba")
    ]
    whole, _ = run_in_parts(messages, [], Limits())
    parts, _ = run_in_parts(messages, range(LEAST - 40, LEAST + 40), Limits())
    assert whole.duplicates.dump() == parts.duplicates.dump()
    assert whole.duplicates.dump()[0] == PER_VEHICLE * 16


def hash_closely(payload, _seed=0):
    """Return a hash near the end of the table, so that most collide and some wrap around."""
    number = int(payload[10:-1]) if payload[:1] == b"{" else 0
    return (number << 32) + (1 << 32) - 1 - number % 3


def hash_texts_closely(text, _words, starts, sizes, _seeds, out):
    out[:] = [hash_closely(text[at : at + size].tobytes()) for at, size in zip(starts, sizes, strict=True)]


@given(numbers=st.lists(st.integers(0, 60), max_size=40, unique=True), step=st.integers(1, 4))
def test_forgotten_messages_are_new_again_and_the_others_are_not(numbers, step):
    filter_, messages = DuplicateFilter(Lanes()), [make_messages(number, number + 1)[0] for number in numbers]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(duplicate_filter, "xxh64_intdigest", hash_closely)
        patch.setattr(duplicate_filter, "hash_texts", hash_texts_closely)
        select_all(filter_, messages)
        filter_.forget([Refused(message) for message in messages[::step]])
        assert select_all(filter_, messages) == messages[::step]
