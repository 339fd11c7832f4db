"""Test that a ride ends when the other cars show that its car is silent, and never because of a wrong clock."""

import numpy as np
import pandas as pd
import pytest

from socast.core.cleaning.fleet_clock import STALLED, advance_fleet_clock, new_fleet_clock
from socast.core.pipeline import Pipeline
from socast.core.settings import Settings
from tests.support.ride_streams import count_ended, in_order, sent
from tests.support.telemetry import PERIOD, START, leaf, ran

GAP = Settings().gap_time
HOUR = 3600.0


def count_all(messages):
    """Return the number of rides that have ended after all messages, which a pipeline takes at once."""
    pipeline = Pipeline(keep_forecasts=False)
    pipeline.take(messages)
    return pipeline.quality()["rides"]


@pytest.mark.parametrize("name", ["r1", None])
@pytest.mark.parametrize("ahead", [0.0, -7 * HOUR], ids=["right", "behind"])
def test_ride_of_silent_car_ends_when_the_fleet_has_advanced_by_the_gap_time(name, ahead):
    messages = in_order(sent("a", 100, ahead=ahead, name=name), sent("b", 400, name=name))
    pipeline = Pipeline(keep_forecasts=False)
    ended = count_ended(messages, pipeline)
    last = max(i for i, message in enumerate(messages) if b'"a"' in message.payload)
    assert GAP / PERIOD < ended.index(1) - last <= GAP / PERIOD + 2
    (ride,) = pipeline.take_rides().to_dict("records")
    assert (ride["vehicle_id"], ride["duration_s"]) == ("a", PERIOD * 99)


def test_ride_of_silent_car_with_clock_ahead_ends_once_the_fleet_clock_runs_again():
    messages = in_order(sent("a", 100, ahead=7 * HOUR), sent("b", int(STALLED) + 400))
    assert count_all(messages[: int(STALLED)]) == 0
    assert count_all(messages) == 1


def test_totals_of_silent_car_equal_those_at_its_next_sample():
    first, later = sent("a", 100), sent("a", 100, first=500)
    alone = ran([leaf("a"), *in_order(first, later)])[0]
    others = ran([leaf("a"), leaf("b"), *in_order(first, later, sent("b", 700))])[0]
    assert len(alone.status()) == 1
    for table in ("take_rides", "take_windows"):
        both = getattr(others, table)()
        mine, only = both[both["vehicle_id"] == "a"].reset_index(drop=True), getattr(alone, table)()
        counts = [
            name for name in only if name.startswith("quality_")
        ]  # the first sample is not believed, only counted
        mine, only = (each.drop(columns=counts) for each in (mine, only))
        pd.testing.assert_frame_equal(mine, only, check_exact=True)


def test_car_with_wrong_clock_ends_no_ride_of_others():
    streams = [sent(car, 400, ahead=ahead) for car, ahead in (("a", 0.0), ("b", 9 * HOUR), ("c", 0.0))]
    assert count_all(in_order(*streams)) == 0


def test_stored_samples_that_come_together_end_no_ride_of_others():
    stored = [(START + PERIOD * 350, message) for _, message in sent("b", 350)]
    assert count_all(in_order(sent("a", 400), sent("c", 400), stored)) == 0


def test_many_cars_that_wake_after_a_night_end_no_ride_that_has_just_begun():
    streams = [sent(car, 50, first=10_000) for car in "abcdefghijklmnopqrstuvwxyz"]
    assert set(count_ended(in_order(sent("z", 5, name=None), *streams))[5 + 2 * 26 :]) <= {
        1
    }  # the first sample of each is not believed


def test_stored_samples_of_a_silent_car_begin_another_ride():
    stored = [message for _, message in sent("a", 50, first=100)]
    rides = ran([leaf("a"), leaf("b"), *in_order(sent("a", 100), sent("b", 400)), *stored])[0].take_rides()
    mine = rides[rides["vehicle_id"] == "a"]
    assert mine["ride_id"].tolist() == ["r1", "r1"]
    assert mine["duration_s"].tolist() == [PERIOD * 99, PERIOD * 49]


def test_clock_that_stands_returns_to_the_present_samples():
    (clock,) = new_fleet_clock()
    advance_fleet_clock(clock, 1e6, 0.0, GAP)
    for i in range(int(STALLED) + 5):
        advance_fleet_clock(clock, PERIOD * i, PERIOD, GAP)
    assert clock["front"] == PERIOD * (STALLED + 4)
    assert clock["progress"] == PERIOD * 5


def test_clock_advances_by_no_more_than_the_step_of_a_car():
    (clock,) = new_fleet_clock()
    for time, dt in ((0.0, 0.0), (3.0, 3.0), (100.0, 3.0), (90.0, 3.0), (5000.0, 4900.0), (5003.0, 3.0)):
        advance_fleet_clock(clock, time, dt, GAP)
    assert clock["progress"] == 9.0


def test_clock_of_a_large_fleet_advances_with_the_time_of_its_cars():
    """Thousands of samples in succession are behind the front, because clocks differ by up to a second."""
    cars, turns = 5000, 20
    rng, clock = np.random.default_rng(1), new_fleet_clock()[0]
    clock["cars"] = cars
    for turn in range(turns):
        for ahead in rng.uniform(0.0, 1.0, cars):
            advance_fleet_clock(clock, PERIOD * turn + ahead, PERIOD if turn else 0.0, GAP)
    assert clock["progress"] == pytest.approx(PERIOD * (turns - 1), abs=PERIOD)


def test_kernel_counts_the_cars_of_the_fleet():
    pipeline = ran([leaf("a"), leaf("b"), *in_order(sent("a", 20), sent("b", 20))])[0]
    assert pipeline.totals.cleaner.fleet_clock["cars"] == 2
