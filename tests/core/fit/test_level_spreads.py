"""Test the evidence of the spreads of the levels, its derivatives, and the spreads that maximise it."""

import numpy as np
import pytest

from socast.core.fit.nested_effects import (
    LevelSpreads,
    LevelSums,
    RideProducts,
    differentiate_level_evidence,
    estimate_spreads,
)
from tests.support.nested_rows import PRIOR, SPREADS, Rows


def test_evidence_differs_between_spreads_as_the_gaussian_density_does():
    def density(spreads: LevelSpreads) -> float:
        rows = Rows(spreads=spreads)
        whole = rows.covariance + rows.design @ PRIOR.covariance @ rows.design.T
        left = Rows().energy - rows.design @ PRIOR.mean
        return -0.5 * float(left @ np.linalg.solve(whole, left) + np.linalg.slogdet(whole)[1])

    sums = LevelSums.of(Rows().products())
    other = LevelSpreads(1.3, 0.1, 0.4, 0.05, 0.3, 0.02)
    here, there = (differentiate_level_evidence(sums, PRIOR, spreads)[0] for spreads in (SPREADS, other))
    assert here - there == pytest.approx(density(SPREADS) - density(other), rel=1e-8)


def test_derivatives_are_those_of_the_evidence():
    sums = LevelSums.of(Rows().products())
    _, derivatives = differentiate_level_evidence(sums, PRIOR, SPREADS)
    for name, derivative in derivatives._asdict().items():
        changed = (SPREADS._replace(**{name: getattr(SPREADS, name) * np.exp(step)}) for step in (1e-5, -1e-5))
        up, down = (differentiate_level_evidence(sums, PRIOR, spreads)[0] for spreads in changed)
        assert derivative == pytest.approx((up - down) / 2e-5, rel=1e-6, abs=1e-6), name


@pytest.mark.parametrize("cars", [True, False])
def test_planted_spreads_are_estimated(cars):
    truth = LevelSpreads(1.0, 0.1, 0.3, 0.08, 0.25, 0.05 if cars else 0.0)
    rows = Rows(seed=3, days=60, cars=6, spreads=truth)
    found = estimate_spreads(rows.products(), PRIOR, cars=cars)
    assert found.row == pytest.approx(1.0, abs=0.1)
    assert found.ride_power == pytest.approx(0.3, rel=0.35)
    assert found.day_power == pytest.approx(0.25, rel=0.4)
    assert (found.car > 0.0) == cars


def test_estimate_has_the_largest_evidence_and_ignores_the_last_digits():
    products = Rows(seed=3, days=20, cars=4).products()
    found = estimate_spreads(products, PRIOR, cars=True)
    noise = np.random.default_rng(1).uniform(-1.0, 1.0, products.sums.shape)
    noise = (noise + np.swapaxes(noise, 1, 2)) / 2.0
    other = RideProducts(products.sums * (1.0 + 1e-14 * noise), *products[1:])
    np.testing.assert_allclose(estimate_spreads(other, PRIOR, cars=True), found, rtol=1e-9)
    far = LevelSpreads(0.5, 0.02, 0.5, 0.2, 0.02, 0.01)
    np.testing.assert_allclose(estimate_spreads(products, PRIOR, cars=True, start=far), found, rtol=1e-7)
