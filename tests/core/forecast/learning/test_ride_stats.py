"""Test that consumption planted in past rides is predicted for planned legs."""

from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from socast.core.forecast.learning.first_tables import FIRST_RELATIVE_SD
from socast.core.forecast.learning.leg_energy import PACES, STEEPEST_DESCENT, TEMPERATURES, compute_knot_weights
from socast.core.forecast.learning.leg_energy_fit import fit_leg_energy
from socast.core.forecast.learning.ride_stats import LEAST_RIDES, RideStatistics
from socast.core.pipeline import Pipeline
from socast.core.totals.accumulator import AMOUNTS, EDGES, Totals
from socast.core.totals.display_record import create_unknown_yields
from tests.support.fleet_days import CAPACITY, LEG, LEGS, RIDE, SETTINGS, columns, idle_morning, shift, trained_pipeline
from tests.support.telemetry import leaf, observed

MODEL = "nissan-leaf-2013"
COLD = {-15.0: 1.4, 0.0: 1.2, 15.0: 1.0}
"""Outside temperature [°C], and the energy of a day over that of a warm one."""
MET = (min(COLD) <= TEMPERATURES) & (max(COLD) > TEMPERATURES)
"""Knots of temperature that the rides have met."""


@cache
def train(planted: str = "cold", rides: int = 12 * 3 * LEGS) -> Pipeline:
    """Return a pipeline trained with rides that need more energy in the cold, or with rides that are all alike."""
    pipeline, driven = Pipeline(settings=SETTINGS), 0
    pipeline.push([observed(temperature_c=10.0), *(leaf(car) for car in "cde")])
    for day in range(12):
        for number, car in enumerate("cde"):
            if driven < rides:
                pipeline.push([m for _, m in shift(car, day, plant(car, day, planted, list(COLD)[(day + number) % 3]))])
                driven += LEGS
    pipeline.push(idle_morning(13, "c"))
    return pipeline


def plant(car, day, planted, celsius):
    """Return the samples of a shift with a planted effect."""
    sent = columns(car, day)
    sent["ambient_c"][:] = celsius
    if planted == "cold":
        sent["soc_pct"] = np.round(2.0 * (95.0 - COLD[celsius] * (95.0 - sent["soc_pct"]))) / 2.0
    return sent


def tables(planted="cold"):
    return train(planted).engine.statistics.get_tables(0)


def energy(km, seconds=None, gained=np.nan, lost=np.nan, known=None):
    """Return the energy of one leg at each temperature, at 36 km/h where no time is given. [kWh]"""
    seconds = 100.0 * km if seconds is None else seconds
    one = (np.array([value], float) for value in (km, seconds, gained, lost))
    return (known or tables()).compute_leg_energy(*one)[0][0]


@given(st.floats(0.5, 50.0), st.floats(1.05, 4.0))
def test_longer_leg_takes_more_energy(km, longer):
    assert (energy(longer * km) > energy(km)).all()


@given(st.floats(0.0, 50.0), st.floats(0.0, 86_400.0), st.floats(0.0, 500.0), st.floats(0.0, 500.0))
def test_no_leg_returns_more_than_its_descent_and_all_are_finite(km, seconds, gained, lost):
    kwh = energy(km, seconds, gained, lost)
    assert np.isfinite(kwh).all()
    assert (kwh >= min(tables().descent_energy, 0.0) * min(lost, STEEPEST_DESCENT * km)).all()


def test_legs_take_more_energy_in_the_cold_where_rides_did():
    at = [int(np.flatnonzero(celsius == TEMPERATURES)[0]) for celsius in (-15.0, 0.0)]
    warm = energy(6.0) @ compute_knot_weights(np.array([15.0]), TEMPERATURES)[0]
    cold, fresh = energy(6.0)[at]
    assert cold / warm == pytest.approx(1.4, abs=0.12)
    assert fresh / warm == pytest.approx(1.2, abs=0.12)


def test_legs_take_no_more_energy_in_the_cold_where_rides_did_not():
    plain = energy(6.0, known=tables("nothing"))[MET]
    assert np.ptp(plain) < 0.1 * plain.mean()


def test_leg_takes_the_mean_energy_of_similar_legs():
    pipeline = trained_pipeline()
    sent = columns("c", 2)
    riding = sent["ride_id"] == "c-2-3"
    legs = energy(np.ptp(sent["metres"][riding]) / 1000.0, RIDE, known=pipeline.engine.statistics.get_tables(2))
    kwh = legs @ compute_knot_weights(np.array([8.0]), TEMPERATURES)[0]
    used = (
        np.mean([0.16 * np.exp(0.15 * np.sin(ord(car))) for car in "abcdef"]) * np.ptp(sent["metres"][riding]) / 1000.0
    )
    nominal = pipeline.cars.capacity[-1]
    assert kwh == pytest.approx(used * nominal / CAPACITY, rel=0.15)


@given(st.floats(1.0, 20.0), st.floats(10.0, 300.0))
def test_uphill_takes_more_and_downhill_less_energy(km, climb):
    level = energy(km, gained=0.0, lost=0.0)
    assert (energy(km, gained=climb, lost=0.0) > level).all()
    assert (energy(km, gained=0.0, lost=climb) <= level).all()
    there_and_back = energy(km, gained=climb, lost=climb)
    assert (there_and_back >= level - 1e-9).all()


@given(st.floats(0.5, 20.0), st.floats(60.0, 300.0))
def test_unknown_climb_counts_as_usual(km, pace):
    known = tables()._replace(climbed_per_km=np.full(len(PACES), 7.0), descended_per_km=np.full(len(PACES), 5.0))
    kwh = energy(km, pace * km, known=known)
    assert kwh == pytest.approx(energy(km, pace * km, 7.0 * km, 5.0 * km, known=known))
    assert (kwh < energy(km, pace * km, 9.0 * km, 5.0 * km, known=known)).all()


def test_leg_of_standing_takes_standing_power():
    hour = energy(0.0, 10_800.0) - energy(0.0, 7200.0)
    assert hour == pytest.approx(tables().standing_power)
    assert tables("nothing").standing_power[MET] == pytest.approx(0.3 * 24.0 / CAPACITY, abs=0.12)


def test_first_tables_serve_a_model_with_few_rides_and_before_the_daily_update():
    learned = train(rides=LEAST_RIDES + 2 * LEGS).engine.statistics
    assert learned.get_tables(0) is learned.rides.tables[MODEL]
    few = train(rides=LEAST_RIDES - LEGS)
    assert few.engine.statistics.rides._sums[MODEL].rides < LEAST_RIDES
    assert few.engine.statistics.rides.tables == {}
    assert (few.engine.statistics.get_tables(0).relative_sd == FIRST_RELATIVE_SD).all()
    today = Pipeline(settings=SETTINGS)
    today.push([leaf("c"), *(m for number in range(6) for _, m in shift("c", 0, columns("c", number) | times()))])
    assert today.engine.statistics.rides.tables == {}


def times():
    """Return stamps of a shift of the first day."""
    return {"time_s": columns("c", 0)["time_s"]}


@given(st.lists(st.floats(-100.0, 100.0), min_size=1, max_size=20))
def test_knot_weights_interpolate_between_two_neighbours(values):
    weights = compute_knot_weights(np.array(values), TEMPERATURES)
    assert weights.sum(axis=1) == pytest.approx(np.ones(len(values)))
    assert (weights >= 0.0).all()
    assert (np.count_nonzero(weights, axis=1) <= 2).all()
    assert weights @ TEMPERATURES == pytest.approx(np.clip(values, TEMPERATURES[0], TEMPERATURES[-1]))


def test_loaded_state_gives_the_same_tables():
    pipeline = train()
    statistics = pipeline.engine.statistics
    other = RideStatistics(pipeline.totals.accumulator.width)
    other.load(statistics.rides.dump())
    assert repr(other.tables) == repr(statistics.rides.tables)
    other.update_tables(pipeline.context)
    assert repr(other.tables) == repr(statistics.rides.tables)


def test_state_does_not_depend_on_which_model_was_seen_first():
    rides, used = driven(tables(), 1, np.random.default_rng(0))
    dumped = []
    for models in (["a", "b"], ["b", "a"]):
        statistics = RideStatistics(len(AMOUNTS))
        for model in models:
            statistics.add_rides([model], rides, used, used)
        statistics.tables = dict.fromkeys(models, tables())
        dumped.append(repr(statistics.dump()))
    assert dumped[0] == dumped[1]


def driven(known, rides, rng):
    """Return rides as `RideStatistics` takes them, and their energy by `known` tables with a little noise. [kWh]"""
    km, pace = rng.uniform(0.5, 8.0, rides), np.exp(rng.normal(np.log(5.0), 0.5, rides))
    celsius, gained, lost = rng.uniform(-20.0, 30.0, rides), *rng.uniform(0.0, 60.0, (2, rides))
    energies, _ = known.compute_leg_energy(km, 60.0 * pace * km, gained, lost)
    used = (energies * compute_knot_weights(celsius, TEMPERATURES)).sum(axis=1) + rng.normal(0.0, 0.02, rides)
    amounts = np.zeros((rides, len(AMOUNTS)))
    ambient = (celsius + 273.15) * 60.0 * pace * km
    values_of_ride = {
        "duration": 60.0 * pace * km,
        "distance": 1000.0 * km,
        "gained": gained,
        "lost": lost,
        "ambient": ambient,
    }
    for name, values in values_of_ride.items():
        amounts[:, AMOUNTS.index(name)] = values
    none, edges = np.zeros(rides, np.int64), np.zeros((rides, len(EDGES)))
    return Totals(
        none, none, none, none, amounts, edges, edges, np.zeros((rides, 1)), create_unknown_yields(rides)
    ), used


def equations_of(statistics):
    """Return the normal equations of the model."""
    return statistics._sums[MODEL].equations


@pytest.mark.parametrize("seed", range(3))
def test_fit_recovers_energy_of_each_pace_and_temperature_that_averages_blur(seed):
    rng = np.random.default_rng(seed)
    truth = tables()._replace(
        leg_energy_per_km=rng.uniform(0.15, 0.3, (len(PACES), len(TEMPERATURES))),
        climb_energy=0.006,
        descent_energy=-0.004,
    )
    blurred = truth._replace(
        leg_energy_per_km=np.full_like(truth.leg_energy_per_km, truth.leg_energy_per_km.mean()),
        climb_energy=0.004,
        start_energy=0.02,
    )
    rides, used = driven(truth, 6000, rng)
    statistics = RideStatistics(len(AMOUNTS))
    statistics.tables = {MODEL: blurred}
    statistics.add_rides([MODEL] * len(used), rides, np.full(len(used), np.nan), used)
    fitted = fit_leg_energy(blurred, equations_of(statistics))
    inside = np.ix_((PACES > 2.0) & (PACES < 10.0), (TEMPERATURES > -20.0) & (TEMPERATURES < 30.0))
    off = [np.abs(known.leg_energy_per_km / truth.leg_energy_per_km - 1.0)[inside].max() for known in (blurred, fitted)]
    assert off[0] > 0.2
    assert off[1] < 0.06
    assert (fitted.climb_energy, fitted.descent_energy) == pytest.approx((0.006, -0.004), abs=5e-4)
    assert fitted.start_energy == pytest.approx(truth.start_energy, abs=0.004)


def test_ride_that_mostly_waited_counts_for_no_pace():
    rides, used = driven(tables(), 1, np.random.default_rng(0))
    rides.amounts[0, AMOUNTS.index("duration")] = 3600.0 * 8.0
    statistics = RideStatistics(len(AMOUNTS))
    statistics.add_rides([MODEL], rides, used, used)
    sums = statistics._sums[MODEL]
    assert not sums.ride_sums.amounts.any()
    assert not sums.ride_sums.energy["hours"].any()
    assert sums.rides == 1


def test_mean_pause_is_that_of_idle_periods():
    assert tables("nothing").mean_pause == pytest.approx((LEG - RIDE) / 3600.0, rel=0.2)


def test_tables_are_averages_fitted_to_the_measured_rides():
    pipeline = train()
    statistics = pipeline.engine.statistics.rides
    plain = RideStatistics(pipeline.totals.accumulator.width)
    plain.load(statistics.dump())
    equations = type(equations_of(plain))(*(part.copy() for part in equations_of(plain)))
    for name in ("matrix", "right"):
        plain._sums[MODEL].sums._parts[name][:] = 0
    plain.update_tables(pipeline.context)
    averages, fitted = plain.tables[MODEL], statistics.tables[MODEL]
    assert not all(np.allclose(a, b) for a, b in zip(averages, fitted, strict=True))
    for again, value in zip(fit_leg_energy(averages, equations), fitted, strict=True):
        np.testing.assert_allclose(again, value, rtol=1e-9)


def test_tables_of_a_former_model_hold_until_there_are_enough_rides_of_one_with_a_new_effect():
    former = train()
    richer = Pipeline(settings=SETTINGS, also=["headwind"])
    richer.restore(former.snapshot())
    learned, kept = former.engine.statistics.rides.tables[MODEL], richer.engine.statistics.rides.tables[MODEL]
    richer.engine.statistics.rides.update_tables(richer.context)
    for tables in (kept, richer.engine.statistics.rides.tables[MODEL]):
        assert np.array_equal(tables.leg_energy_per_km, learned.leg_energy_per_km)
