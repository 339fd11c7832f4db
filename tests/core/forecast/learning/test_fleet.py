"""Test that statistics take effect at the daily update, and that only representative data count."""

import numpy as np
import pytest

from socast.core.forecast.learning.car_driver import compute_driver_code
from socast.core.forecast.learning.consumption_terms import GAINED, WAITING
from socast.core.forecast.learning.fleet import FleetStatistics
from socast.core.pipeline import Pipeline
from tests.support.fleet_days import (
    DAYS,
    LEG,
    LEGS,
    PERIOD,
    RIDE,
    SETTINGS,
    columns,
    days,
    forecasts,
    idle_morning,
    plan,
    shift,
    trained_pipeline,
)
from tests.support.telemetry import leaf, make_message, telemetry


def count_learned(statistics):
    """Return the number of rides and of idle periods in the sums of the day."""
    sums = statistics.energies._models.values()
    return sum(each.today.get("counts") for each in sums) if sums else np.zeros(2)


def effective(statistics):
    """Return everything that forecasts read."""
    conformal = statistics.conformal.table.tolist()
    plans = statistics.plan_outcomes.factor.tolist(), statistics.plan_outcomes.variance
    read = statistics.prior.tolist(), statistics.patterns.tobytes(), plans, statistics.factors._cold_loss
    cycle = statistics.daily_cycle._since_midnight.tolist()
    return repr((statistics.get_tables(0), conformal, read, cycle))


def test_statistics_take_effect_at_daily_update_and_only_once():
    pipeline = trained_pipeline()
    statistics = pipeline.engine.statistics
    before, tables, known = effective(statistics), statistics.get_tables(2), count_learned(statistics)
    pipeline.push(days([DAYS], "abcde"))
    assert effective(statistics) == before
    assert statistics.get_tables(2) is tables
    assert count_learned(statistics)[0] >= known[0] + 5 * (LEGS - 1)
    pipeline.push(idle_morning(DAYS + 1))
    assert effective(statistics) != before
    statistics.apply_daily_update()
    once = repr(statistics.dump())
    statistics.apply_daily_update()
    assert repr(statistics.dump()) == once


def test_other_cars_of_the_same_day_change_no_forecast():
    """Forecasts use the statistics of the days before only."""
    calm, wild = trained_pipeline(), trained_pipeline()
    wild.push(days([DAYS], "abde"))
    sent = [m for _, m in shift("c", DAYS)]
    assert calm.push(sent) == [m for m in wild.push(sent) if "/c/" in m.key]


@pytest.mark.parametrize("number", [0, 1, 2, 5])
def test_forecasts_need_no_rides_and_become_surer_with_them(number):
    pipeline = trained_pipeline(number)
    made = forecasts(pipeline.push([m for _, m in shift("c", number)]), "c")
    assert {each.soc_end_of_shift_pct is not None for each in list(made.values())[2:]} == {True}
    first = trained_pipeline(0)
    first.push([m for _, m in shift("c", 0)])
    surer, unsure = (each.engine.statistics.get_tables(2).level_sd for each in (pipeline, first))
    assert (surer <= unsure).all()
    assert (surer[4] < 0.5 * unsure[4]) == (number > 0)


def test_charging_and_silent_idle_periods_do_not_count():
    def rested(change):
        """Return the number of idle periods that count, and their time. [s]"""
        pipeline, sent = trained_pipeline(), columns("d", DAYS)
        passed = sent["time_s"] - sent["time_s"][0]
        mine = np.flatnonzero((passed >= RIDE) & (passed < LEG))
        sent = change(sent, mine[3:-3])
        before = rests(pipeline.engine.statistics)
        pipeline.push([m for _, m in shift("d", DAYS, sent)])
        return rests(pipeline.engine.statistics) - before

    plain = rested(lambda sent, _: sent)
    plugged = rested(lambda sent, rows: sent | {"charging": np.isin(np.arange(len(sent["time_s"])), rows)})
    silent = rested(lambda sent, rows: late(sent, rows[-1], 1200.0))
    assert plain[0] == LEGS  # one of them is of the evening before
    assert plugged[0] == LEGS - 1
    assert plain[1] - plugged[1] == pytest.approx(LEG - RIDE, abs=2.0 * PERIOD)
    assert silent[1] < plain[1]


def rests(statistics):
    """Return the number of idle periods in the sums of the day, and their total time. [s]"""
    hours = sum(each.today.get("idle")[WAITING] for each in statistics.energies._models.values())
    return np.array([count_learned(statistics)[1], 3600.0 * hours])


def late(sent, at, seconds):
    """Return samples that are later by `seconds` from a row on, as if those between were lost."""
    after = np.arange(len(sent["time_s"])) >= at
    return sent | {"time_s": sent["time_s"] + seconds * after, "seq": sent["seq"] + int(seconds / PERIOD) * after}


def test_unfit_ride_does_not_count():
    pipeline, slow = trained_pipeline(), columns("e", DAYS)
    slow["speed_kmh"][:] = 0.5
    before = count_learned(pipeline.engine.statistics)[0]
    pipeline.push([m for _, m in shift("e", DAYS, slow)])
    assert count_learned(pipeline.engine.statistics)[0] == before
    pipeline.push([m for _, m in shift("d", DAYS)])
    assert count_learned(pipeline.engine.statistics)[0] >= before + LEGS - 1


def test_pending_statistics_survive_dump_and_load():
    pipeline = trained_pipeline()
    pipeline.push(days([DAYS], "abc"))
    pipeline.push([m for _, m in shift("d", DAYS)][:200])
    statistics = pipeline.engine.statistics
    other = FleetStatistics(pipeline.context)
    other.load(statistics.dump())
    assert repr(other.dump()) == repr(statistics.dump())
    assert effective(other) == effective(statistics)
    for each in (statistics, other):
        each.apply_daily_update()
    assert repr(other.dump()) == repr(statistics.dump())
    assert effective(other) == effective(statistics)


def test_known_driver_changes_the_forecast():
    pipeline = trained_pipeline()
    another = pipeline.lanes.lane("another")
    for _ in range(30):
        pipeline.engine.statistics.factors.add_shift(another, compute_driver_code("heavy"), 20.0, 26.0, 24.0)
        pipeline.engine.statistics.factors.add_shift(another, compute_driver_code("other"), 20.0, 20.0, 24.0)
    kept = pipeline.snapshot()
    by_driver = {}
    for name in ("heavy", "other", None):
        pipeline = trained_pipeline()
        pipeline.restore(kept)
        begin = float(columns("c", DAYS)["time_s"][0])
        drives = make_message("ride", "c", begin, ride_id="c", event="start", **({"driver_id": name} if name else {}))
        samples = telemetry(columns("c", DAYS), "c")[:20]
        out = forecasts(pipeline.push([samples[0], plan("c", DAYS, begin), drives, *samples[1:]]), "c")
        by_driver[name] = out[max(out)].soc_end_of_shift_pct.mean
    assert by_driver["heavy"] < by_driver[None]
    assert by_driver["heavy"] < by_driver["other"]


def test_level_of_the_tables_is_not_learned_of_the_cars_as_well():
    """A fleet that takes twice what is official has twice the tables, and its cars take what their tables say."""
    pipeline = trained_pipeline()
    statistics = pipeline.engine.statistics
    assert statistics.energies.get_level("nissan-leaf-2013") == pytest.approx(0.06, abs=0.1)
    means = [statistics.factors.expect(lane).mean for lane in range(6)]
    assert np.mean(means) == pytest.approx(np.log(24.0 / 21.6), abs=0.08)  # the capacity differs from the catalogue's


@pytest.mark.parametrize("order", ["ab", "ba"])
def test_cars_of_one_name_have_the_physics_of_their_own_mass(order):
    masses = {"a": 1000.0, "b": 3000.0}
    pipeline = Pipeline(settings=SETTINGS)
    pipeline.push([leaf(car, mass_kg=masses[car]) for car in order])
    statistics = pipeline.engine.statistics
    light, heavy = (statistics.get_tables(pipeline.lanes.lane(car)).rates[0, GAINED] for car in "ab")
    assert heavy == pytest.approx(3.0 * light)
