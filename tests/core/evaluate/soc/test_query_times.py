"""Test that queries fall where the event time of a vehicle enters another slot, however messages are divided."""

from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from socast.core.evaluate.soc.recorders import QUERY_INTERVAL, QueryTimes
from socast.core.wire.messages import Message
from tests.support.batched_recordings import make_batch


def sample(car, time, receipt=0):
    return Message(f"fleet/{car}/telemetry", b'{"vehicle_id": "%s", "time_s": %r}' % (car.encode(), time), receipt)


def queries(lists):
    """Return the number of messages before each query, and its vehicle."""
    times, taken, found = QueryTimes(), 0, []
    for messages in lists:
        for part, due in times.cut(messages):
            taken += len(part)
            found += [(taken, due)] if due else []
    assert taken == sum(map(len, lists))
    return found


def divided(messages, ends):
    """Return messages as lists that end at some places."""
    cuts = [0, *sorted(ends), len(messages)]
    return [messages[a:b] for a, b in pairwise(cuts)]


def test_vehicle_is_due_before_its_first_sample_of_another_slot():
    times = [10.0, QUERY_INTERVAL - 1.0, QUERY_INTERVAL, QUERY_INTERVAL + 5.0, 7.5 * QUERY_INTERVAL]
    assert queries([[sample("a", time) for time in times]]) == [(2, "a"), (4, "a")]


def test_each_vehicle_has_its_own_slots():
    messages = [sample("a", 0.0), sample("b", 0.0), sample("a", QUERY_INTERVAL), sample("b", QUERY_INTERVAL)]
    assert queries([messages]) == [(2, "a"), (3, "b")]


@given(st.data())
@settings(max_examples=40, deadline=None)
def test_division_into_lists_changes_no_query(data):
    steps = st.tuples(st.sampled_from("abc"), st.floats(-600.0, 2400.0))
    messages, clock = [], 1.5e9
    for car, step in data.draw(st.lists(steps, max_size=40)):
        clock += step
        messages.append(sample(car, clock))
    ends = data.draw(st.lists(st.integers(0, len(messages)), max_size=6))
    assert queries(divided(messages, ends)) == queries([messages])


def test_time_of_receipt_has_no_influence():
    messages = [sample("a", 100.0 * i, receipt=i * 10**14) for i in range(60)]
    assert queries([messages]) == queries([[sample("a", 100.0 * i) for i in range(60)]])


@pytest.mark.parametrize(
    "payload", [b"", b"[]", b"{", b"\xff", b'{"time_s": "noon"}', b'{"time_s": null}', b'{"time_s": 1e999}', b"[" * 99]
)
def test_message_without_time_calls_for_no_query(payload):
    messages = [sample("a", 0.0), Message("fleet/a/telemetry", payload, 0), sample("a", 3.0)]
    assert queries([messages]) == []
    assert queries([[*messages, sample("a", QUERY_INTERVAL)]]) == [(3, "a")]


def test_other_messages_call_for_no_query_and_lists_of_samples_count_by_their_first():
    several = Message("fleet/a/telemetry", b'[{"time_s": 1800.0}, {"time_s": 9999.0}]', 0)
    plan = Message("fleet/a/plan", b'{"time_s": 9999.0}', 0)
    odd = Message("fleet/a/lunch", b'{"time_s": 9999.0}', 0)
    assert queries([[sample("a", 0.0), plan, odd, several, sample("a", 1803.0)]]) == [(3, "a")]


def batch(key, *rows):
    return make_batch([{"vehicle_id": car, "time_s": time} for car, time in rows], key)


def test_each_vehicle_of_a_batch_is_due_before_the_batch_with_its_first_sample_of_another_slot():
    first = batch("fleet/depot/batch", ("a", 0.0), ("b", 3.0), ("c", 3.0))
    second = batch("fleet/depot/batch", ("a", QUERY_INTERVAL), ("b", 6.0), ("c", 1805.0), ("a", 9999.0))
    broken = Message("fleet/depot/batch", b'{"time_s": 9999.0}', 0)
    assert queries([[first, broken], [second]]) == [(2, "a"), (2, "c")]


def test_batch_of_one_car_counts_as_its_samples_in_json():
    own = batch("fleet/a/telemetry", ("b", 9999.0), ("a", QUERY_INTERVAL))
    assert queries([[sample("a", 0.0), own, sample("b", 9999.0)]]) == [(1, "a")]
