"""Test that elimination of random effects level by level equals generalised least squares with the whole covariance."""

import numpy as np

from socast.core.fit.nested_effects import (
    EXPECTED_LEVELS,
    RideProducts,
    compute_coefficients,
    eliminate,
    integrate_car_factor,
)
from tests.support.nested_rows import PRIOR, SPREADS, Rows


def test_elimination_equals_generalised_least_squares():
    rows = Rows()
    elimination = eliminate(rows.products(), SPREADS)
    total = integrate_car_factor(elimination.cars, SPREADS.car).sums.sum(axis=0)
    posterior = compute_coefficients(PRIOR, total)
    inverse = np.linalg.inv(rows.covariance)
    precision = np.linalg.inv(PRIOR.covariance)
    covariance = np.linalg.inv(rows.design.T @ inverse @ rows.design + precision)
    mean = covariance @ (rows.design.T @ inverse @ rows.energy + precision @ PRIOR.mean)
    np.testing.assert_allclose(posterior.mean, mean, rtol=1e-9)
    np.testing.assert_allclose(posterior.covariance, covariance, rtol=1e-8)


def test_sums_of_a_part_equal_sums_of_the_rest():
    rows = Rows()
    products = rows.products()
    elimination = eliminate(products, SPREADS)
    kept = rows.day != 4
    part = RideProducts(products.sums[kept], products.rows[kept], np.arange(8).repeat(2), np.delete(rows.car, 4))
    rest = elimination.cars[1] - elimination.days[4]
    np.testing.assert_allclose(eliminate(part, SPREADS).cars[1], rest, rtol=1e-9, atol=1e-9)


def test_thinned_products_keep_whole_days():
    products = Rows(days=40).products()
    some = products.thinned(60)
    assert 58 <= len(some.rows) <= 62
    assert (np.bincount(some.day) == 2).all()
    assert products.thinned(10_000) is products
    assert EXPECTED_LEVELS.row == 1.0
