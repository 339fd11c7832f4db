"""Test that rides that end between samples give the same results for any cut of the input and after any restart."""

from functools import cache

import pandas as pd
from hypothesis import given
from hypothesis import strategies as st

from tests.support.fleet_days import DAY as ONE_DAY
from tests.support.fleet_days import DAYS, LEG, LEGS, RIDE, START, merged, plan, trained_pipeline
from tests.support.fleet_days import shift as planned_shift
from tests.support.ride_streams import in_order, run_parts, sent, shift
from tests.support.telemetry import chunked, make_message

FLEET = in_order(shift("a"), shift("b", rides=1), shift("c", rides=2), sent("d", 700, name="d"))
BEGIN = START + ONE_DAY * DAYS


@cache
def run_whole():
    """Return the forecasts and the tables of an uninterrupted run."""
    return run_parts([FLEET])


@given(cuts=st.lists(st.integers(0, len(FLEET)), max_size=6), restart=st.booleans())
def test_cuts_and_restarts_change_no_result(cuts, restart):
    forecasts, tables = run_whole()
    parts, others = run_parts(chunked(FLEET, cuts), restart=restart)
    assert parts == forecasts
    assert len(tables[0]) == 7
    for one, other in zip(others, tables, strict=True):
        pd.testing.assert_frame_equal(one, other, check_exact=True)


def test_restart_before_and_after_each_end_changes_no_result():
    places = [i for i, message in enumerate(FLEET) if b'"end"' in message.payload]
    forecasts, tables = run_whole()
    parts, others = run_parts(chunked(FLEET, [at + step for at in places for step in (0, 1)]), restart=True)
    assert parts == forecasts
    assert all(one.equals(other) for one, other in zip(others, tables, strict=True))


def orders(car, first):
    """Return timed ends of the rides of a car, with a plan directly before or after each, some of them sent late."""
    timed = []
    for number in range(LEGS - 1):
        end = BEGIN + LEG * number + RIDE - 20.0
        name = f"{car}-{DAYS}-{number}"
        both = [
            (end, make_message("ride", car, end, ride_id=name, event="end")),
            (end, plan(car, DAYS, end - 120.0 * (number % 2), last=LEGS - 1 - number)),
        ]
        timed += both if first == "end" else both[::-1]
    return timed


def test_plan_and_end_between_the_same_samples_apply_in_the_order_of_their_arrival():
    published = []
    for first in ("end", "plan"):
        messages = merged(planned_shift("a", DAYS), planned_shift("c", DAYS), orders("a", first), orders("c", first))
        places = [i for i, message in enumerate(messages) if message.key.endswith(("/plan", "/ride"))]
        whole = [m.payload for m in trained_pipeline().push(messages)]
        pipeline = trained_pipeline()
        parts = [m.payload for part in chunked(messages, places) for m in pipeline.push(part)]
        assert parts == whole
        published.append(whole)
    assert published[0] != published[1]
