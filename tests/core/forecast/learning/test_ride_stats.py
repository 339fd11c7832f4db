"""How rides go: what was planted in those that were driven is expected of those that are planned."""

from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from core.forecast.learning.leg_energy import PACES, STEEPEST, TEMPERATURES, tents
from core.forecast.learning.ride_stats import LEAST_RIDES, Habits
from core.forecast.learning.tabulated import fitted
from core.pipeline import Pipeline
from core.totals.accumulator import AMOUNTS, EDGES, Totals
from tests.support.fleet_days import CAPACITY, LEG, LEGS, RIDE, SETTINGS, again, columns, night, shift
from tests.support.telemetry import leaf, observed

MODEL = "nissan-leaf-2013"
COLD = {-15.0: 1.4, 0.0: 1.2, 15.0: 1.0}
"""Outside temperature [°C], and the energy of a day over that of a warm one."""


@cache
def taught(planted: str = "cold", rides: int = 12 * 3 * LEGS) -> Pipeline:
    """Return a pipeline that has learned from rides in which the cold was planted, or which were all alike."""
    pipeline, driven = Pipeline(settings=SETTINGS), 0
    pipeline.push([observed(temperature_c=10.0), *(leaf(car) for car in "cde")])
    for day in range(12):
        for number, car in enumerate("cde"):
            if driven < rides:
                pipeline.push([m for _, m in shift(car, day, told(car, day, planted, list(COLD)[(day + number) % 3]))])
                driven += LEGS
    pipeline.push(night(13, "c"))
    return pipeline


def told(car, day, planted, celsius):
    """Return the samples of a shift that something was planted in."""
    sent = columns(car, day)
    if planted == "cold":
        sent["ambient_c"][:] = celsius
        sent["soc_pct"] = np.round(2.0 * (95.0 - COLD[celsius] * (95.0 - sent["soc_pct"]))) / 2.0
    return sent


def tables(planted="cold"):
    return taught(planted).foresight.lessons.tables(0)


def energy(km, seconds=None, gained=np.nan, lost=np.nan, known=None):
    """Return the energy of one leg at each temperature, at 36 km/h where no time is given. [kWh]"""
    seconds = 100.0 * km if seconds is None else seconds
    one = (np.array([value], float) for value in (km, seconds, gained, lost))
    return (known or tables()).legs(*one)[0]


@given(st.floats(0.5, 50.0), st.floats(1.05, 4.0))
def test_more_kilometres_take_more(km, longer):
    assert (energy(longer * km) > energy(km)).all()


@given(st.floats(0.0, 50.0), st.floats(0.0, 86_400.0), st.floats(0.0, 500.0), st.floats(0.0, 500.0))
def test_no_leg_gives_back_more_than_its_descent_and_all_are_known(km, seconds, gained, lost):
    found = energy(km, seconds, gained, lost)
    assert np.isfinite(found).all()
    assert (found >= min(tables().down, 0.0) * min(lost, STEEPEST * km)).all()


def test_where_rides_took_more_in_the_cold_legs_do():
    at = [int(np.flatnonzero(celsius == TEMPERATURES)[0]) for celsius in (-15.0, 0.0)]
    warm = energy(6.0) @ tents(np.array([15.0]), TEMPERATURES)[0]
    cold, fresh = energy(6.0)[at]
    assert cold / warm == pytest.approx(1.4, abs=0.12)
    assert fresh / warm == pytest.approx(1.2, abs=0.12)


def test_where_they_did_not_legs_do_not():
    plain = energy(6.0, known=tables("nothing"))
    assert np.ptp(plain) < 0.1 * plain.mean()


def test_a_leg_takes_what_such_legs_took():
    pipeline = again()
    sent = columns("c", 2)
    riding = sent["ride_id"] == "c-2-3"
    found = energy(np.ptp(sent["metres"][riding]) / 1000.0, RIDE, known=pipeline.foresight.lessons.tables(2))
    used = (
        np.mean([0.16 * np.exp(0.15 * np.sin(ord(car))) for car in "abcdef"]) * np.ptp(sent["metres"][riding]) / 1000.0
    )
    nominal = pipeline.cars.capacity[-1]
    assert found.mean() == pytest.approx(used * nominal / CAPACITY, rel=0.15)


@given(st.floats(1.0, 20.0), st.floats(10.0, 300.0))
def test_uphill_takes_more_and_downhill_less(km, climb):
    level = energy(km, gained=0.0, lost=0.0)
    assert (energy(km, gained=climb, lost=0.0) > level).all()
    assert (energy(km, gained=0.0, lost=climb) <= level).all()
    there_and_back = energy(km, gained=climb, lost=climb)
    assert (there_and_back >= level - 1e-9).all()


@given(st.floats(0.5, 20.0), st.floats(60.0, 300.0))
def test_unknown_climbs_are_as_usual(km, pace):
    known = tables()._replace(climbed_per_km=np.full(len(PACES), 7.0), descended_per_km=np.full(len(PACES), 5.0))
    found = energy(km, pace * km, known=known)
    assert found == pytest.approx(energy(km, pace * km, 7.0 * km, 5.0 * km, known=known))
    assert (found < energy(km, pace * km, 9.0 * km, 5.0 * km, known=known)).all()


def test_a_leg_of_standing_takes_what_standing_takes():
    hour = energy(0.0, 10_800.0) - energy(0.0, 7200.0)
    assert hour == pytest.approx(tables().standing)
    assert tables("nothing").standing == pytest.approx(0.3 * 24.0 / CAPACITY, abs=0.12)


def test_nothing_is_expected_of_a_model_with_few_rides_nor_before_the_night():
    assert taught(rides=LEAST_RIDES + 2 * LEGS).foresight.lessons.tables(0) is not None
    few = taught(rides=LEAST_RIDES - LEGS)
    assert few.foresight.lessons.habits._sums[MODEL].counts[0] < LEAST_RIDES
    assert few.foresight.lessons.tables(0) is None
    today = Pipeline(settings=SETTINGS)
    today.push([leaf("c"), *(m for number in range(6) for _, m in shift("c", 0, columns("c", number) | times()))])
    assert today.foresight.lessons.habits.tables == {}


def times():
    """Return stamps of a shift of the first day."""
    return {"time_s": columns("c", 0)["time_s"]}


@given(st.lists(st.floats(-100.0, 100.0), min_size=1, max_size=20))
def test_tents_share_every_value_between_its_two_neighbours(values):
    weights = tents(np.array(values), TEMPERATURES)
    assert weights.sum(axis=1) == pytest.approx(np.ones(len(values)))
    assert (weights >= 0.0).all()
    assert (np.count_nonzero(weights, axis=1) <= 2).all()
    assert weights @ TEMPERATURES == pytest.approx(np.clip(values, TEMPERATURES[0], TEMPERATURES[-1]))


def test_what_was_dumped_is_there_again_and_settles_to_the_same():
    pipeline = taught()
    lessons = pipeline.foresight.lessons
    other = Habits(pipeline.ledger.width)
    other.load(lessons.habits.dump())
    assert repr(other.tables) == repr(lessons.habits.tables)
    other.settle(pipeline.context)
    assert repr(other.tables) == repr(lessons.habits.tables)


def driven(known, rides, rng):
    """Return rides as `Habits` takes them, and what they took by `known` tables, read with a little noise. [kWh]"""
    km, pace = rng.uniform(0.5, 8.0, rides), np.exp(rng.normal(np.log(5.0), 0.5, rides))
    celsius, gained, lost = rng.uniform(-20.0, 30.0, rides), *rng.uniform(0.0, 60.0, (2, rides))
    energies = known.legs(km, 60.0 * pace * km, gained, lost)
    used = (energies * tents(celsius, TEMPERATURES)).sum(axis=1) + rng.normal(0.0, 0.02, rides)
    amounts = np.zeros((rides, len(AMOUNTS)))
    ambient = (celsius + 273.15) * 60.0 * pace * km
    told = {"duration": 60.0 * pace * km, "distance": 1000.0 * km, "gained": gained, "lost": lost, "ambient": ambient}
    for name, values in told.items():
        amounts[:, AMOUNTS.index(name)] = values
    none, edges = np.zeros(rides, np.int64), np.zeros((rides, len(EDGES)))
    return Totals(none, none, none, none, amounts, edges, edges, np.zeros((rides, 1))), used


@pytest.mark.parametrize("seed", range(3))
def test_what_rides_took_is_told_apart_at_every_pace_and_temperature_though_averages_blur_it(seed):
    rng = np.random.default_rng(seed)
    truth = tables()._replace(per_km=rng.uniform(0.15, 0.3, (len(PACES), len(TEMPERATURES))), up=0.006, down=-0.004)
    blurred = truth._replace(per_km=np.full_like(truth.per_km, truth.per_km.mean()), up=0.004, start=0.02)
    rides, used = driven(truth, 6000, rng)
    habits = Habits(len(AMOUNTS))
    habits.tables = {MODEL: blurred}
    habits.ridden([MODEL] * len(used), rides, np.full(len(used), np.nan), used)
    found = fitted(blurred, habits._sums[MODEL].equations)
    inside = np.ix_((PACES > 2.0) & (PACES < 10.0), (TEMPERATURES > -20.0) & (TEMPERATURES < 30.0))
    off = [np.abs(known.per_km / truth.per_km - 1.0)[inside].max() for known in (blurred, found)]
    assert off[0] > 0.2
    assert off[1] < 0.06
    assert (found.up, found.down) == pytest.approx((0.006, -0.004), abs=5e-4)
    assert found.start == pytest.approx(truth.start, abs=0.004)


def test_a_ride_that_waited_tells_of_no_pace():
    rides, used = driven(tables(), 1, np.random.default_rng(0))
    rides.amounts[0, AMOUNTS.index("duration")] = 3600.0 * 8.0
    habits = Habits(len(AMOUNTS))
    habits.ridden([MODEL], rides, used, used)
    assert not habits._sums[MODEL].rides.any()
    assert habits._sums[MODEL].counts[0] == 1.0


def test_a_rest_lasts_as_long_as_rests_did():
    assert tables("nothing").pause == pytest.approx((LEG - RIDE) / 3600.0, rel=0.2)


def test_tables_are_those_of_averages_fitted_to_what_rides_took():
    pipeline = taught()
    habits = pipeline.foresight.lessons.habits
    plain = Habits(pipeline.ledger.width)
    plain.load(habits.dump())
    equations = plain._sums[MODEL].equations.copy()
    plain._sums[MODEL].equations[:] = 0.0
    plain.settle(pipeline.context)
    assert repr(plain.tables[MODEL]) != repr(habits.tables[MODEL])
    assert repr(fitted(plain.tables[MODEL], equations)) == repr(habits.tables[MODEL])
