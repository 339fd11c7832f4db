"""Test partial pooling against closed forms of Bayes' rule, its limits and planted values."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import multivariate_normal

from socast.core.fit.partial_pooling import (
    Prior,
    build_covariance,
    compute_column_scale,
    compute_common_mean,
    compute_early_posterior,
    compute_log_evidence,
    compute_posterior,
    estimate_car_factors,
    estimate_common_noise,
    estimate_noise,
    estimate_prior,
    sum_normal_equations,
)

BLOCKS = (np.array([True, True, True, False]), np.array([False, False, False, True]))
PHYSICS = np.array([1.0, 1.0, 1.0, 0.0])


def some(rides: int, coefficients, seed: int, noise: float = 0.01):
    """Return the design, energy and size of rides, with terms of different size. [kWh]"""
    random = np.random.default_rng(seed)
    size = random.uniform(0.2, 4.0, rides)
    design = size[:, np.newaxis] * random.uniform(0.1, 1.0, (rides, 4)) * [1.0, 0.5, 0.3, 100.0]
    energy = design @ coefficients + random.normal(0.0, np.sqrt(noise * size))
    return design, energy, size


def prior(seed: int = 0) -> Prior:
    """Return a prior with correlated coefficients."""
    random = np.random.default_rng(seed)
    half = random.normal(size=(4, 4)) * np.array([0.2, 0.2, 0.2, 0.002])[:, np.newaxis]
    return Prior(np.array([1.0, 0.8, 0.5, 0.003]), half @ half.T + np.diag([1e-3, 1e-3, 1e-3, 1e-7]), 0.01)


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 1000), rides=st.integers(1, 30))
def test_posterior_equals_that_of_a_conditioned_gaussian(seed, rides):
    before = prior(seed)
    design, energy, size = some(rides, before.mean * 1.2, seed)
    energy_covariance = design @ before.covariance @ design.T + np.diag(before.noise * size)
    gain = before.covariance @ design.T @ np.linalg.inv(energy_covariance)
    posterior_mean, covariance = compute_posterior(before, sum_normal_equations(design, energy, size))
    np.testing.assert_allclose(
        posterior_mean, before.mean + gain @ (energy - design @ before.mean), rtol=1e-6, atol=1e-9
    )
    expected = before.covariance - gain @ design @ before.covariance
    np.testing.assert_allclose(covariance, expected, rtol=1e-5, atol=1e-8)


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 1000))
def test_posterior_is_the_same_in_steps_as_from_all_rides_at_once(seed):
    before = prior(seed)
    design, energy, size = some(20, before.mean, seed)
    at_once = compute_posterior(before, sum_normal_equations(design, energy, size))
    first = compute_posterior(before, sum_normal_equations(design[:7], energy[:7], size[:7]))
    then = compute_posterior(Prior(*first, before.noise), sum_normal_equations(design[7:], energy[7:], size[7:]))
    np.testing.assert_allclose(then[0], at_once[0], rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(then[1], at_once[1], rtol=1e-5, atol=1e-9)


def test_evidence_equals_the_log_probability_of_energies_up_to_a_constant():
    design, energy, size = some(12, np.array([1.1, 0.7, 0.4, 0.002]), 4)
    sums = sum_normal_equations(design, energy, size)
    evidence, truth = [], []
    for seed in range(5):
        before = prior(seed)
        energy_covariance = design @ before.covariance @ design.T + np.diag(before.noise * size)
        evidence.append(compute_log_evidence(before, sums))
        truth.append(multivariate_normal(design @ before.mean, energy_covariance).logpdf(energy))
    np.testing.assert_allclose(np.diff(evidence), np.diff(truth), rtol=1e-6)


def test_many_rides_outweigh_the_prior():
    planted = np.array([1.4, 0.6, 0.9, 0.004])
    mean, covariance = compute_posterior(prior(), sum_normal_equations(*some(20_000, planted, 5)))
    np.testing.assert_allclose(mean, planted, rtol=0.05)
    assert (np.abs(mean - planted) < 4.0 * np.sqrt(np.diag(covariance))).all()


def test_first_rides_of_a_vehicle_model_count_less_than_later_ones():
    sums = sum_normal_equations(*some(3, np.array([1.4, 0.6, 0.9, 0.004]), 6))
    before = prior()
    late, early = compute_posterior(before, sums), compute_early_posterior(before, sums)
    assert np.trace(early[1][:3, :3]) > np.trace(late[1][:3, :3])


def test_planted_noise_is_recovered():
    sums = sum_normal_equations(*some(4000, np.array([1.0, 0.8, 0.5, 0.003]), 7, noise=0.02))
    scale = compute_column_scale([sums])
    assert estimate_noise(sums, PHYSICS, scale) == pytest.approx(0.02, rel=0.06)
    assert estimate_common_noise([sums, sums], PHYSICS) == pytest.approx(0.02, rel=0.06)


def test_common_mean_moves_from_physics_to_the_data_with_more_rides():
    planted = np.array([1.5, 1.5, 1.5, 0.0])
    few = compute_common_mean([sum_normal_equations(*some(1, planted, 8))], PHYSICS)
    many = compute_common_mean([sum_normal_equations(*some(50_000, planted, 8))], PHYSICS)
    assert np.abs(few - PHYSICS)[:3].max() < 0.3
    assert np.abs(many - planted)[:3].max() < 0.2


def test_vehicle_models_with_more_rides_weigh_more_in_the_mean():
    low, high = np.array([1.0, 1.0, 1.0, 0.0]), np.array([2.0, 2.0, 2.0, 0.0])
    means = [
        compute_common_mean(
            [sum_normal_equations(*some(1000, low, 1)), sum_normal_equations(*some(rides, high, 2))], PHYSICS
        )[:3].mean()
        for rides in (10, 300, 1000, 30_000)
    ]
    assert means == sorted(means)
    assert 1.0 < means[0] < 1.1
    assert means[2] == pytest.approx(1.5, abs=0.05)


@pytest.mark.parametrize("factor", [0.03, 0.3])
def test_planted_spread_between_vehicle_models_is_recovered(factor):
    random = np.random.default_rng(1)
    common = np.array([1.2, 0.8, 0.6, 0.003])
    groups = {}
    for i, deviation in enumerate(random.normal(0.0, 1.0, 12)):
        planted = common * np.where(BLOCKS[0], 1.0 + factor * deviation, 1.0)
        groups[str(i)] = sum_normal_equations(*some(2000, planted, 100 + i))
    estimated = estimate_prior(groups, PHYSICS, BLOCKS)
    direction = np.where(BLOCKS[0], estimated.mean, 0.0)
    spread = np.sqrt(direction @ np.linalg.lstsq(estimated.covariance, direction, rcond=None)[0]) ** -1
    assert spread == pytest.approx(factor, rel=0.6)
    # a new vehicle model lies within two standard deviations of the mean
    design, energy, size = some(400, common * np.where(BLOCKS[0], 1.0 + factor, 1.0), 999)
    error = (energy - design @ estimated.mean) / np.sqrt(
        np.einsum("ij,jk,ik->i", design, estimated.covariance, design) + estimated.noise * size
    )
    assert np.std(error) < 2.0


def test_prior_from_one_vehicle_model_is_finite_and_positive_definite():
    estimated = estimate_prior(
        {"only": sum_normal_equations(*some(500, np.array([1.2, 0.8, 0.6, 0.003]), 3))}, PHYSICS, BLOCKS
    )
    assert np.isfinite(estimated.covariance).all()
    assert (np.linalg.eigvalsh(estimated.covariance) > 0.0).all()


def test_term_that_is_zero_in_all_rides_stays_at_physics():
    design, energy, size = some(500, np.array([1.2, 0.8, 0.6, 0.003]), 3)
    design[:, 2] = 0.0
    estimated = estimate_prior(
        {"a": sum_normal_equations(design, energy, size), "b": sum_normal_equations(design, energy, size)},
        PHYSICS,
        BLOCKS,
    )
    assert estimated.mean[2] == PHYSICS[2]
    after, _ = compute_posterior(estimated, sum_normal_equations(design, energy, size))
    assert np.isfinite(after).all()


def test_one_ride_moves_all_coefficients_of_a_block_by_a_common_factor():
    mean, scale = np.array([1.2, 0.8, 0.6, 0.003]), np.ones(4)
    before = Prior(mean, build_covariance(mean, scale, BLOCKS, 1e-4, (0.3, 0.3)), 1e-6)
    design = np.array([[1.0, 0.0, 0.0, 0.0]])
    posterior, _ = compute_posterior(before, sum_normal_equations(design, np.array([1.2 * 1.25]), np.ones(1)))
    np.testing.assert_allclose(posterior[:3], mean[:3] * 1.25, rtol=1e-3)
    assert posterior[3] == pytest.approx(mean[3])


def cars(factors: np.ndarray, rides: int, seed: int = 0):
    """Return rides of cars whose energy is their factor times the prediction."""
    random = np.random.default_rng(seed)
    car = np.repeat(np.arange(len(factors)), rides)
    predicted = random.uniform(0.2, 4.0, len(car))
    energy = predicted * factors[car] + random.normal(0.0, np.sqrt(0.01 * predicted))
    return np.array([f"taxi-{i}" for i in car], dtype=object), predicted, energy, predicted, 0.01


def test_planted_factors_of_cars_are_recovered():
    truth = np.random.default_rng(2).normal(1.0, 0.08, 30)
    factors = estimate_car_factors(*cars(truth, 200))
    np.testing.assert_allclose([factors[f"taxi-{i}"] for i in range(30)], truth, atol=0.02)


def test_factors_from_few_rides_are_shrunk_and_more_accurate_for_it():
    truth = np.random.default_rng(2).normal(1.0, 0.05, 300)
    names, predicted, energy, size, noise = cars(truth, 3)
    factors = np.array([estimate_car_factors(names, predicted, energy, size, noise)[f"taxi-{i}"] for i in range(300)])
    raw = np.array([energy[i * 3 : i * 3 + 3].sum() / predicted[i * 3 : i * 3 + 3].sum() for i in range(300)])
    assert np.std(factors) < np.std(raw)
    assert np.mean((factors - truth) ** 2) < 0.8 * min(np.mean((raw - truth) ** 2), np.var(truth) + 1e-9)


def test_equal_cars_have_no_factor():
    factors = [estimate_car_factors(*cars(np.ones(20), 50, seed)) for seed in range(6)]
    assert sum(not by_car for by_car in factors) >= 2
    assert all(abs(factor - 1.0) < 0.02 for by_car in factors for factor in by_car.values())
    assert estimate_car_factors(*cars(np.array([1.3]), 50)) == {}
