"""Test that the errors of driving and of waiting are told apart, and that the correction knows its uncertainty."""

import numpy as np
import pytest

from socast.core.forecast.learning.energy_correction import EnergyCorrection, PartForecasts
from socast.core.forecast.learning.leg_energy import TEMPERATURES, compute_knot_weights


def learned(days, driving=1.0, waiting=1.0, celsius=(5.0,), noise=0.01, seed=1, shifts=5):
    """Return what shifts teach in which driving and waiting take these multiples of their forecasts."""
    rng, correction = np.random.default_rng(seed), EnergyCorrection(2)
    for _ in range(days):
        for _ in range(shifts):
            one, other = rng.uniform(0.05, 0.3, (2, 6))
            fall = driving * one + waiting * other + noise * rng.normal(size=6)
            where = np.full(6, rng.choice(celsius))
            correction.add_shift(0, PartForecasts(one, other, where, fall, np.full(6, 0.02)))
        correction.apply_daily_update()
    return correction


def at(correction, celsius, basis=0):
    """Return factors and their standard deviations at a temperature, (2,) each."""
    weights = compute_knot_weights(np.array([celsius]), TEMPERATURES)[0]
    variance = np.einsum("k,kpp->p", weights, correction.covariance[basis])
    return correction.factor[basis] @ weights, np.sqrt(variance)


@pytest.mark.parametrize(("driving", "waiting"), [(1.0, 1.0), (0.9, 1.3), (1.15, 0.8)])
def test_driving_and_waiting_are_told_apart(driving, waiting):
    factor, _ = at(learned(60, driving, waiting), 5.0)
    assert factor == pytest.approx([driving, waiting], abs=0.04)


def test_before_any_shift_the_factors_are_one_and_less_certain_in_the_cold():
    factor, mild = at(EnergyCorrection(2), 17.0)
    assert factor.tolist() == [1.0, 1.0]
    assert (at(EnergyCorrection(2), -20.0)[1] > 1.2 * mild).all()


def test_uncertainty_falls_where_temperatures_were_met():
    correction = learned(40, celsius=(4.0, 8.0))
    assert (at(correction, 6.0)[1] < 0.5 * at(EnergyCorrection(2), 6.0)[1]).all()
    assert (at(correction, -20.0)[1] > 2.0 * at(correction, 6.0)[1]).all()


def test_other_basis_learns_nothing():
    assert (learned(20, 1.3).factor[1] == 1.0).all()


def test_impossible_outcome_counts_as_a_large_error():
    plain, spoilt = learned(40), learned(40)
    one = np.full(1, 0.2)
    spoilt.add_shift(0, PartForecasts(one, one, np.full(1, 5.0), np.full(1, 50.0), np.full(1, 0.02)))
    spoilt.apply_daily_update()
    assert at(spoilt, 5.0)[0] == pytest.approx(at(plain, 5.0)[0], abs=0.05)


def test_shift_with_unknown_forecasts_teaches_nothing():
    correction, unknown = EnergyCorrection(2), np.full(2, np.nan)
    correction.add_shift(0, PartForecasts(unknown, unknown, np.full(2, 5.0), unknown, unknown))
    correction.apply_daily_update()
    assert (correction.factor == 1.0).all()


def test_shifts_take_effect_at_the_daily_update_and_survive_dump_and_load():
    one, other = learned(5, 1.2), EnergyCorrection(2)
    part = np.array([0.2, 0.1])
    before = one.factor.copy()
    one.add_shift(0, PartForecasts(part, part, np.full(2, -5.0), 3.0 * part, np.full(2, 0.02)))
    assert (one.factor == before).all()
    other.load(one.dump())
    for each in (one, other):
        each.apply_daily_update()
    assert one.dump() == other.dump()
    assert (one.factor == other.factor).all()
    assert (one.factor != before).any()
