"""What is learned through the day takes effect overnight, and only what can be learned from is learned from."""

import numpy as np
import pytest

from core.forecast.conformal import LEAST
from core.forecast.learning.car_driver import code_of
from core.forecast.learning.fleet import Lessons
from core.forecast.learning.ride_stats import LEAST_RIDES
from core.totals.accumulator import AMOUNTS
from tests.support.fleet_days import (
    CARS,
    DAYS,
    LEG,
    LEGS,
    PERIOD,
    RIDE,
    again,
    columns,
    days,
    forecasts,
    night,
    plan,
    shift,
)
from tests.support.telemetry import telemetry, told


def counted(lessons):
    """Return how many rides were learned from, and how many rests."""
    return sum(own.counts for own in lessons.habits._sums.values()).tolist()


def effective(lessons):
    """Return what forecasts read."""
    conformal = lessons.conformal.table.tolist(), lessons.conformal.bounds.tolist()
    read = lessons.prior.tolist(), lessons._shifts.tolist(), lessons.lean.factor.tolist()
    return repr((lessons.habits.tables, conformal, read))


def test_what_a_day_teaches_takes_effect_overnight_and_only_once():
    pipeline = again()
    lessons = pipeline.foresight.lessons
    before, tables, known = effective(lessons), lessons.tables(2), counted(lessons)
    pipeline.push(days([DAYS], "abcde"))
    assert effective(lessons) == before
    assert lessons.tables(2) is tables
    assert counted(lessons)[0] >= known[0] + 5 * (LEGS - 1)
    pipeline.push(night(DAYS + 1))
    assert effective(lessons) != before
    lessons.overnight()
    once = repr(lessons.dump())
    lessons.overnight()
    assert repr(lessons.dump()) == once


def test_forecasts_of_a_day_rest_on_the_nights_before_it():
    """Whatever is driven on the same day by others, however differently, changes no forecast of it."""
    calm, wild = again(), again()
    wild.push(days([DAYS], "abde"))
    sent = [m for _, m in shift("c", DAYS)]
    assert calm.push(sent) == [m for m in wild.push(sent) if "/c/" in m.key]


@pytest.mark.parametrize("number", [0, 1, 2, 5])
def test_nothing_is_expected_before_enough_rides_and_no_interval_before_enough_shifts(number):
    pipeline = again(number)
    found = forecasts(pipeline.push([m for _, m in shift("c", number)]), "c")
    enough = number * len(CARS) * (LEGS - 1) >= LEAST_RIDES
    assert (pipeline.foresight.lessons.tables(2) is not None) == enough
    foretold = {each.soc_end_of_shift_pct is not None for each in list(found.values())[2:]}
    assert foretold == {number * len(CARS) - len(CARS) >= LEAST}


def test_of_charging_and_of_silence_nothing_is_learned():
    def rested(change):
        """Return how many rests were learned from, and for how long."""
        pipeline, sent = again(), columns("d", DAYS)
        passed = sent["time_s"] - sent["time_s"][0]
        mine = np.flatnonzero((passed >= RIDE) & (passed < LEG))
        sent = change(sent, mine[3:-3])
        before = rests(pipeline.foresight.lessons)
        pipeline.push([m for _, m in shift("d", DAYS, sent)])
        return rests(pipeline.foresight.lessons) - before

    plain = rested(lambda sent, _: sent)
    plugged = rested(lambda sent, rows: sent | {"charging": np.isin(np.arange(len(sent["time_s"])), rows)})
    silent = rested(lambda sent, rows: late(sent, rows[-1], 1200.0))
    assert plain[0] == LEGS  # one of them the evening before's
    assert plugged[0] == LEGS - 1
    assert plain[1] - plugged[1] == pytest.approx(LEG - RIDE, abs=2.0 * PERIOD)
    assert silent[1] < plain[1]


def rests(lessons):
    """Return how many rests were learned from, and their time together. [s]"""
    sums = lessons.habits._sums.values()
    return np.array([counted(lessons)[1], sum(own.rests[:, AMOUNTS.index("duration")].sum() for own in sums)])


def late(sent, at, seconds):
    """Return samples that from a row on come so much later, those between having been lost."""
    after = np.arange(len(sent["time_s"])) >= at
    return sent | {"time_s": sent["time_s"] + seconds * after, "seq": sent["seq"] + int(seconds / PERIOD) * after}


def test_a_ride_that_is_unfit_is_not_learned_from():
    pipeline, slow = again(), columns("e", DAYS)
    slow["speed_kmh"][:] = 0.5
    before = counted(pipeline.foresight.lessons)[0]
    pipeline.push([m for _, m in shift("e", DAYS, slow)])
    assert counted(pipeline.foresight.lessons)[0] == before
    pipeline.push([m for _, m in shift("d", DAYS)])
    assert counted(pipeline.foresight.lessons)[0] >= before + LEGS - 1


def test_what_is_pending_survives_a_dump():
    pipeline = again()
    pipeline.push(days([DAYS], "abc"))
    pipeline.push([m for _, m in shift("d", DAYS)][:200])
    lessons = pipeline.foresight.lessons
    other = Lessons(pipeline.context, pipeline.ledger.width)
    other.load(lessons.dump())
    assert repr(other.dump()) == repr(lessons.dump())
    assert effective(other) == effective(lessons)
    for each in (lessons, other):
        each.overnight()
    assert repr(other.dump()) == repr(lessons.dump())
    assert effective(other) == effective(lessons)


def test_a_driver_who_is_known_makes_the_forecast_another():
    pipeline = again()
    for _ in range(30):
        pipeline.foresight.lessons.scales.learn(90, code_of("heavy"), 20.0, 26.0, 24.0)
        pipeline.foresight.lessons.scales.learn(90, code_of("other"), 20.0, 20.0, 24.0)
    kept = pipeline.snapshot()
    found = {}
    for name in ("heavy", "other", None):
        pipeline = again()
        pipeline.restore(kept)
        begin = float(columns("c", DAYS)["time_s"][0])
        drives = told("ride", "c", begin, ride_id="c", event="start", **({"driver_id": name} if name else {}))
        samples = telemetry(columns("c", DAYS), "c")[:20]
        out = forecasts(pipeline.push([samples[0], plan("c", DAYS, begin), drives, *samples[1:]]), "c")
        found[name] = out[max(out)].soc_end_of_shift_pct.mean
    assert found["heavy"] < found[None]
    assert found["heavy"] < found["other"]
