"""Consumption at temperatures that were not met follows from physics, and is less certain the farther away they are."""

import numpy as np
import pytest

from socast.core.columns import ZERO_CELSIUS
from socast.core.forecast.learning.leg_energy import TEMPERATURES
from socast.core.forecast.learning.leg_energy_fit import ENERGY_SUMS
from socast.core.forecast.learning.temperature_transfer import (
    fit_corrections,
    make_standing_amounts,
    shift_amounts,
)
from socast.core.models import EXTENDED_PHYSICAL
from socast.core.pipeline import Pipeline
from socast.core.totals.accumulator import AMOUNTS
from socast.core.vehicles import ACCESSORIES
from socast.core.vehicles.fleet import CarParameters

CAR = CarParameters(*(np.array([value]) for value in (1500.0, 0.01, 0.7, 24.0, 1.3)))
HEATING = 1.3e-3 * (ACCESSORIES.power(TEMPERATURES + ZERO_CELSIUS) - ACCESSORIES.standby)
MET = (TEMPERATURES >= 0.0) & (TEMPERATURES <= 14.0)


def sum_energy(power, hours):
    """Return sums over hours of driving at the temperatures that were met, by a model that lacks a power."""
    sums = np.zeros(len(TEMPERATURES), ENERGY_SUMS)
    for at in np.flatnonzero(MET):
        sums[at] = make_row(power[at], hours, at)
    return sums


def make_row(lacking, hours, seed):
    """Return the sums over hours of driving at one temperature."""
    rng = np.random.default_rng(seed)
    predicted = rng.uniform(2.0, 6.0, hours)
    measured = predicted + lacking + rng.normal(0.0, 0.1, hours)
    row = np.zeros((), ENERGY_SUMS)
    weight = 1.0 / 0.1**2
    row["predicted"], row["measured"], row["hours"] = predicted.sum(), measured.sum(), hours
    row["pp"], row["ph"], row["hh"] = weight * (predicted @ predicted), weight * predicted.sum(), weight * hours
    row["pm"], row["hm"] = weight * (predicted @ measured), weight * measured.sum()
    return row


def make_context():
    """Return the context of a pipeline with the model that has an accessory curve."""
    return Pipeline(EXTENDED_PHYSICAL).context


@pytest.mark.parametrize("strength", [0.5, 1.0])
def test_heating_in_deep_cold_follows_from_mild_cold(strength):
    known = fit_corrections(sum_energy(strength * HEATING, 40), np.full(len(TEMPERATURES), 0.3), 1.3)
    assert known.factor == pytest.approx(np.ones(len(TEMPERATURES)), abs=0.1)
    deep = TEMPERATURES < 0.0
    assert known.power[deep] == pytest.approx(strength * HEATING[deep], rel=0.25, abs=0.2)


def test_model_that_has_the_heating_needs_no_further_power():
    known = fit_corrections(sum_energy(0.0 * HEATING, 40), 0.3 + HEATING, 1.3)
    assert known.power == pytest.approx(np.zeros(len(TEMPERATURES)), abs=0.25)


def test_without_data_heating_is_that_of_the_reference_car_unless_the_model_has_it():
    nothing = np.zeros(len(TEMPERATURES), ENERGY_SUMS)
    assert fit_corrections(nothing, np.full(len(TEMPERATURES), 0.3), 1.3).power == pytest.approx(HEATING)
    assert fit_corrections(nothing, 0.3 + HEATING, 1.3).power == pytest.approx(0.0 * HEATING, abs=1e-9)


def test_uncertainty_grows_with_the_distance_from_what_was_met():
    known = fit_corrections(sum_energy(HEATING, 40), np.full(len(TEMPERATURES), 0.3), 1.3)
    predicted, hours = np.full(len(TEMPERATURES), 4.0), np.ones(len(TEMPERATURES))
    sd = known.compute_relative_sd(predicted, hours)
    first, last = np.flatnonzero(MET)[[0, -1]]
    assert (np.diff(sd[: first + 1] * known.compute_energy(predicted, hours)[: first + 1]) < 0.0).all()
    assert (np.diff(sd[last:]) > 0.0).all()
    assert sd[MET].max() < 0.03 < sd[0]


def test_intervals_hold_the_energy_in_deep_cold():
    """Cars whose heating differs from the reference curve in strength and in shape."""
    rng = np.random.default_rng(1)
    predicted, hours = np.full(len(TEMPERATURES), 4.0), np.ones(len(TEMPERATURES))
    inside = []
    for _ in range(60):
        strength, bend = rng.uniform(0.4, 1.4), rng.uniform(0.8, 1.2)
        lacking = strength * HEATING.max() * (HEATING / HEATING.max()) ** bend
        known = fit_corrections(sum_energy(lacking, 30), np.full(len(TEMPERATURES), 0.3), 1.3)
        energy = known.compute_energy(predicted, hours)
        error = (predicted + lacking - energy) / (1.645 * known.compute_relative_sd(predicted, hours) * energy)
        inside += (np.abs(error[TEMPERATURES < -7.0]) <= 1.0).tolist()
    assert np.mean(inside) > 0.8


def test_amounts_moved_to_their_own_temperature_stay_the_same():
    context = make_context()
    rng = np.random.default_rng(2)
    amounts = rng.uniform(1.0, 9.0, (3, len(AMOUNTS) + len(context.effects)))
    celsius = np.array([-20.0, 5.0, 30.0])
    amounts[:, AMOUNTS.index("ambient")] = (celsius + ZERO_CELSIUS) * amounts[:, AMOUNTS.index("duration")]
    assert shift_amounts(amounts, celsius, context, CAR) == pytest.approx(amounts)


def test_effects_of_temperature_move_and_others_do_not():
    context = make_context()
    standing = make_standing_amounts(len(AMOUNTS) + len(context.effects), np.array([10.0]), context, CAR)
    moved = shift_amounts(standing, np.array([-15.0]), context, CAR)
    place = len(AMOUNTS) + list(context.effects).index("accessories")
    watts = 1.3 * ACCESSORIES.power(np.array([10.0, -15.0]) + ZERO_CELSIUS)
    assert [standing[0, place], moved[0, place]] == pytest.approx((3600.0 * watts).tolist())
    same = [len(AMOUNTS) + list(context.effects).index(name) for name in ("rolling", "inertia", "climbing")]
    assert (moved[0, same] == standing[0, same]).all()


def test_effects_that_the_model_does_not_read_are_left_alone():
    pipeline = Pipeline(EXTENDED_PHYSICAL, also=("cabin_heating",))
    context = pipeline.context
    standing = make_standing_amounts(len(AMOUNTS) + len(context.effects), np.array([-10.0]), context, CAR)
    assert standing[0, len(AMOUNTS) + list(context.effects).index("cabin_heating")] == 0.0
    assert standing[0, len(AMOUNTS) + list(context.effects).index("accessories")] > 0.0
