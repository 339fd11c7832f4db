"""What is gathered through the day takes effect overnight, and only what can be learned from is gathered."""

import numpy as np
import pytest
from conftest import telemetry, told
from fleet_days import CARS, DAYS, LEG, LEGS, PERIOD, RIDE, again, columns, days, forecasts, plan, shift

from core.ahead.conformal import LEAST
from core.ahead.habits import LEAST_RIDES
from core.ahead.lessons import Lessons
from core.sums import AMOUNTS


def night(pipeline, day):
    """Let a night fall: two samples of another day."""
    sent = {name: values[:2] for name, values in columns("f", day).items()}
    sent["ride_id"][:] = None
    pipeline.push(telemetry(sent, "f"))
    return pipeline.foresight.lessons


def gathered(lessons):
    return len(lessons._rides), len(lessons._rests), len(lessons._judged), len(lessons._took), len(lessons._went)


def state(lessons):
    learned, _, _, prior, shifts = lessons.dump()
    return repr((learned, prior, shifts))


def test_what_a_day_teaches_takes_effect_overnight_and_only_once():
    pipeline = again()
    before, tables = state(pipeline.foresight.lessons), pipeline.foresight.lessons.tables(2)
    pipeline.push(days([DAYS], "abcde"))
    lessons = pipeline.foresight.lessons
    assert state(lessons) == before
    assert lessons.tables(2) is tables
    assert gathered(lessons)[0] >= 5 * (LEGS - 1)
    night(pipeline, DAYS + 1)
    assert state(lessons) != before
    assert gathered(lessons)[0] == 0
    lessons.overnight()
    once = state(lessons)
    lessons.overnight()
    assert state(lessons) == once


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
    def rests(change):
        pipeline, sent = again(), columns("d", DAYS)
        passed = sent["time_s"] - sent["time_s"][0]
        mine = np.flatnonzero((passed >= RIDE) & (passed < LEG))
        sent = change(sent, mine[3:-3])
        pipeline.push([m for _, m in shift("d", DAYS, sent)])
        return [row[1][AMOUNTS.index("duration")] for row in pipeline.foresight.lessons._rests]

    plain = rests(lambda sent, _: sent)
    plugged = rests(lambda sent, rows: sent | {"charging": np.isin(np.arange(len(sent["time_s"])), rows)})
    silent = rests(lambda sent, rows: late(sent, rows[-1], 1200.0))
    assert len(plain) == LEGS  # one of them the evening before's
    assert len(plugged) == LEGS - 1
    assert sum(silent) < sum(plain)
    assert max(silent) == max(plain)


def late(sent, at, seconds):
    """Return samples that from a row on come so much later, those between having been lost."""
    after = np.arange(len(sent["time_s"])) >= at
    return sent | {"time_s": sent["time_s"] + seconds * after, "seq": sent["seq"] + int(seconds / PERIOD) * after}


def test_a_ride_that_is_unfit_is_not_gathered_and_one_that_is_long_is():
    pipeline, sent = again(), columns("d", DAYS)
    sent["ride_id"][:] = "all day"
    sent["ride_id"][-1] = None
    pipeline.push([m for _, m in shift("d", DAYS, sent)])
    assert gathered(pipeline.foresight.lessons)[0] in {0, 1}
    short = columns("e", DAYS)
    short["speed_kmh"][:] = 0.5
    before = gathered(pipeline.foresight.lessons)[0]
    pipeline.push([m for _, m in shift("e", DAYS, short)])
    assert gathered(pipeline.foresight.lessons)[0] == before


def test_what_is_pending_survives_a_dump():
    pipeline = again()
    pipeline.push(days([DAYS], "abc"))
    pipeline.push([m for _, m in shift("d", DAYS)][:200])
    lessons = pipeline.foresight.lessons
    other = Lessons(pipeline.model, pipeline.cars, pipeline._effect_names, pipeline.settings, pipeline.ledger.width)
    other.load(lessons.dump())
    assert repr(other.dump()) == repr(lessons.dump())
    for each in (lessons, other):
        each.overnight()
    assert repr(other.dump()) == repr(lessons.dump())
    assert repr(other.habits.tables) == repr(lessons.habits.tables)


def test_a_driver_who_is_known_makes_the_forecast_another():
    pipeline = again()
    for _ in range(30):
        pipeline.foresight.lessons.scales.learn(90, "heavy", 20.0, 26.0, 24.0)
        pipeline.foresight.lessons.scales.learn(90, "other", 20.0, 20.0, 24.0)
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
