"""Test that consumption planted in past rides is predicted for planned legs."""

from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from socast.core.forecast.learning.consumption_terms import (
    COLD_BELOW,
    DRIVING,
    EXPANSION,
    KM,
    LOST,
    STRETCH_AMOUNTS,
    TEMPERATURES,
    TERMS,
    compute_knot_weights,
    compute_stretch_amounts,
    make_prior,
)
from socast.core.forecast.learning.energy_regression import DAY_SD, EnergyRegressions, ModelSums, StretchRows
from socast.core.forecast.learning.leg_energy import STEEPEST_DESCENT
from socast.core.forecast.soc_filter import ENERGY_SD
from socast.core.pipeline import Pipeline
from socast.core.vehicles import ACCESSORIES, load_catalogue
from tests.support.fleet_days import CAPACITY, LEG, LEGS, RIDE, SETTINGS, columns, idle_morning, shift, trained_pipeline
from tests.support.telemetry import leaf, observed

MODEL = "nissan-leaf-2013"
COLD = {-15.0: 1.4, 0.0: 1.2, 15.0: 1.0}
"""Outside temperature [°C], and the energy of a day over that of a warm one."""
MET = (min(COLD) <= TEMPERATURES) & (max(COLD) > TEMPERATURES)
"""Knots of temperature that the rides have met."""
PRIOR = make_prior(load_catalogue()[MODEL], 1.0)


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


def make_rows(n, seed, cars=4, scale=0.0):
    """Return rides and idle periods whose energies are those of planted coefficients, and the coefficients.

    `scale` is the relative standard deviation of a car on its day.
    """
    rng = np.random.default_rng(seed)
    riding, amounts = rng.uniform(size=n) < 0.6, np.empty((n, STRETCH_AMOUNTS))
    km, hours = rng.uniform(0.5, 12.0, n), rng.uniform(0.1, 0.6, n)
    compute_stretch_amounts(riding, np.where(riding, km, 0.3), hours, *rng.uniform(0.0, 60.0, (2, n)), amounts)
    weights = compute_knot_weights(rng.uniform(-20.0, 30.0, n), TEMPERATURES)
    truth = PRIOR.mean + 0.5 * PRIOR.sd * rng.normal(size=len(TERMS))
    terms = np.einsum("nt,na,tai->ni", weights, amounts, EXPANSION)
    lane, sd = rng.integers(0, cars, n), np.full(n, 0.05)
    of_day = scale * rng.normal(size=cars)
    noise = np.sqrt(sd**2 + ENERGY_SD**2 * terms @ PRIOR.mean) * rng.normal(size=n)
    used = terms @ truth + of_day[lane] * (terms @ PRIOR.mean) + noise
    return StretchRows(lane, riding, amounts, weights, used, sd, np.full(n, np.nan)), truth, terms


def test_physics_predicts_before_any_ride():
    first = EnergyRegressions().build_tables(MODEL, PRIOR)
    rated = load_catalogue()[MODEL].rated_kwh_per_km
    mild, cold = (energy(10.0, known=first)[list(TEMPERATURES).index(at)] for at in (14.0, -15.0))
    assert mild / 10.0 == pytest.approx(0.75 * rated, rel=0.1)  # the label includes charging losses
    heating = (ACCESSORIES.power(np.array([258.15]))[0] - ACCESSORIES.standby) / 1000.0
    colder = 0.006 * (14.0 + 15.0) * 0.75 * rated * 10.0
    assert cold - mild == pytest.approx(1000.0 / 3600.0 * heating + colder, rel=0.05)
    assert COLD_BELOW > 14.0
    assert first.level_sd.min() > 0.15


@pytest.mark.parametrize("seed", range(3))
def test_planted_energies_are_recovered(seed):
    rows, truth, terms = make_rows(4000, seed, cars=400)
    sums = ModelSums(PRIOR.mean)
    sums.add(rows)
    sums.apply_daily_update(PRIOR)
    mean, covariance = sums.solve(PRIOR)
    assert np.abs(terms @ (mean - truth)).mean() < 0.2 * np.abs(terms @ (PRIOR.mean - truth)).mean()
    scores = terms @ (mean - truth) / np.sqrt(np.einsum("ni,ij,nj->n", terms, covariance, terms))
    assert np.mean(np.abs(scores) < 1.96) > 0.85


def test_deviation_of_a_day_is_integrated_out():
    """The sums equal those of a regression whose rows of a car are correlated."""
    rows, _, terms = make_rows(60, 5, cars=3, scale=0.1)
    expected = np.maximum(terms @ PRIOR.mean, 0.0)
    rows = rows._replace(energy=1.05 * expected)  # near what is expected, so that no row has less weight
    sums = ModelSums(PRIOR.mean)
    sums.add(rows)
    shared = DAY_SD**2 * np.outer(expected, expected) * (rows.lane[:, np.newaxis] == rows.lane)
    inverse = np.linalg.inv(np.diag(rows.sd**2 + ENERGY_SD**2 * expected) + shared)
    assert sums.today.get("matrix") == pytest.approx(terms.T @ inverse @ terms)
    assert sums.today.get("right") == pytest.approx(terms.T @ inverse @ rows.energy)


def test_many_rides_of_one_day_tell_little_of_the_level():
    sds = []
    for cars in (1, 100):
        rows, _, _ = make_rows(600, 7, cars, scale=DAY_SD)
        sums = ModelSums(PRIOR.mean)
        sums.add(rows)
        sums.apply_daily_update(PRIOR)
        regressions = EnergyRegressions()
        regressions._models[MODEL] = sums
        sds.append(regressions.build_tables(MODEL, PRIOR).level_sd[4])
    assert sds[0] > 0.08
    assert sds[1] < 0.5 * sds[0]


def test_impossible_energy_changes_little():
    rows, _, terms = make_rows(400, 8, cars=40)
    energies = []
    for factor in (1.0, 8.0):
        wrong = rows.energy.copy()
        wrong[:4] *= factor
        sums = ModelSums(PRIOR.mean)
        sums.add(rows._replace(energy=wrong))
        sums.apply_daily_update(PRIOR)
        energies.append(terms @ sums.mean)
    assert energies[1].sum() == pytest.approx(energies[0].sum(), rel=0.05)


def test_stuck_display_teaches_nothing_and_one_with_coarse_steps_does():
    rows, _, _ = make_rows(40, 10, cars=1)
    still = np.arange(40) % 2 > 0
    coarse = rows._replace(energy=np.where(still, 0.0, rows.energy), most_still=np.where(still, 5.0, 0.0))
    stuck = coarse._replace(energy=np.where(np.arange(40) < 20, rows.energy, 0.0))
    stuck = stuck._replace(most_still=np.where(np.arange(40) < 20, 0.0, 5.0))
    learned = []
    for each in (coarse, coarse._replace(most_still=rows.most_still), stuck, stuck.rows(np.arange(20))):
        sums = ModelSums(PRIOR.mean)
        sums.add(each)
        sums.apply_daily_update(PRIOR)
        learned.append(sums.known.get("right"))
    assert learned[0] == pytest.approx(learned[1])
    assert (learned[2] == learned[3]).all()


def test_level_follows_the_energy_of_the_usual_rides():
    rows, _, _ = make_rows(2000, 9, cars=200)
    sums = ModelSums(PRIOR.mean)
    sums.add(rows._replace(energy=1.3 * rows.energy))
    sums.apply_daily_update(PRIOR)
    terms = sums.known.get("terms")
    assert sums.level == pytest.approx(np.log(terms @ sums.mean / (terms @ PRIOR.mean)))


@given(st.floats(0.5, 50.0), st.floats(1.05, 4.0))
def test_longer_leg_takes_more_energy(km, longer):
    assert (energy(longer * km) > energy(km)).all()


@given(st.floats(0.0, 50.0), st.floats(0.0, 86_400.0), st.floats(0.0, 500.0), st.floats(0.0, 500.0))
def test_no_leg_returns_more_than_its_descent_and_all_are_finite(km, seconds, gained, lost):
    kwh = energy(km, seconds, gained, lost)
    assert np.isfinite(kwh).all()
    assert (kwh >= np.minimum(tables().rates[:, LOST], 0.0) * min(lost, STEEPEST_DESCENT * km) - 1e-9).all()


def test_legs_take_more_energy_in_the_cold_where_rides_did():
    at = [int(np.flatnonzero(celsius == TEMPERATURES)[0]) for celsius in (-15.0, 0.0)]
    warm = energy(6.0) @ compute_knot_weights(np.array([15.0]), TEMPERATURES)[0]
    cold, fresh = energy(6.0)[at]
    assert cold / warm == pytest.approx(1.4, abs=0.15)
    assert fresh / warm == pytest.approx(1.2, abs=0.12)


def test_legs_take_hardly_more_energy_in_the_cold_where_rides_did_not():
    plain = energy(6.0, known=tables("nothing"))[MET]
    assert np.ptp(plain) < 0.15 * plain.mean()


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
    rides = tables().mix.rides.copy()
    rides[LOST - 1 : LOST + 1] = np.array([7.0, 5.0]) * rides[KM]
    known = tables()._replace(mix=tables().mix._replace(rides=rides))
    kwh = energy(km, pace * km, known=known)
    assert kwh == pytest.approx(energy(km, pace * km, 7.0 * km, 5.0 * km, known=known))
    assert (kwh < energy(km, pace * km, 9.0 * km, 5.0 * km, known=known)).all()


def test_air_outweighs_stops_on_a_fast_way():
    """Before any data, stops and air balance at moderate speeds, and air dominates on a motorway."""
    first = EnergyRegressions().build_tables(MODEL, PRIOR)
    driving = first.rates[:, DRIVING]
    city, even, fast = (
        energy(10.0, 36000.0 / speed, 0.0, 0.0, first) - driving * 10.0 / speed for speed in (20.0, 55.0, 110.0)
    )
    assert city == pytest.approx(even, rel=0.15)
    assert (fast > 1.3 * even).all()


def test_leg_of_standing_takes_standing_power():
    hour = energy(0.0, 10_800.0) - energy(0.0, 7200.0)
    assert hour == pytest.approx(tables().standing_power)


def test_usual_mix_is_that_of_the_rides():
    pause = tables("nothing").mean_pause
    assert pause == pytest.approx((LEG - RIDE) / 3600.0, rel=0.3)
    speed = 60.0 / tables("nothing").ride_pace
    assert speed == pytest.approx(3.6 * 11.0, rel=0.15)


def test_loaded_state_gives_the_same_tables():
    energies = train().engine.statistics.energies
    other = EnergyRegressions()
    other.load(energies.dump())
    assert repr(other.dump()) == repr(energies.dump())
    assert repr(other.build_tables(MODEL, PRIOR)) == repr(energies.build_tables(MODEL, PRIOR))


def test_state_does_not_depend_on_which_model_was_seen_first():
    rows, _, _ = make_rows(1, 0)
    dumped = []
    for models in (["a", "b"], ["b", "a"]):
        energies = EnergyRegressions()
        for model in models:
            energies.add([model], rows, lambda _: PRIOR)
        dumped.append(repr(energies.dump()))
    assert dumped[0] == dumped[1]


@given(st.lists(st.floats(-100.0, 100.0), min_size=1, max_size=20))
def test_knot_weights_interpolate_between_two_neighbours(values):
    weights = compute_knot_weights(np.array(values), TEMPERATURES)
    assert weights.sum(axis=1) == pytest.approx(np.ones(len(values)))
    assert (weights >= 0.0).all()
    assert (np.count_nonzero(weights, axis=1) <= 2).all()
    assert weights @ TEMPERATURES == pytest.approx(np.clip(values, TEMPERATURES[0], TEMPERATURES[-1]))


def test_meter_that_shows_nothing_leaves_finite_sums():
    rows, _, _ = make_rows(20, 11)
    zero = np.zeros(20)
    sums = ModelSums(-PRIOR.mean)
    sums.add(rows._replace(energy=zero, sd=zero))
    assert np.isfinite(sums.today.get("matrix")).all()
    assert np.isfinite(sums.today.get("right")).all()
