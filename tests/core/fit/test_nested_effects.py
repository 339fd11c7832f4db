"""Test that elimination of random effects level by level equals generalised least squares with the whole covariance."""

import numpy as np
import pytest

from core.fit.nested_effects import (
    EXPECTED_LEVELS,
    Gaussian,
    LevelSpreads,
    RideProducts,
    compute_coefficients,
    compute_level_evidence,
    eliminate,
    estimate_spreads,
    sum_products,
    without_car_factor,
)

SPREADS = LevelSpreads(0.8, 0.3, 0.2, 0.25, 0.15, 0.1)
PRIOR = Gaussian(np.array([1.0, 0.5, 0.2]), np.diag([0.3, 0.2, 0.1]) ** 2)
GUESS = np.array([1.1, 0.4, 0.3])


class Rows:
    """Rows of three cars of three days of two rides, with their whole covariance."""

    def __init__(self, seed: int = 1, days: int = 3, cars: int = 3, spreads: LevelSpreads = SPREADS) -> None:
        rng = np.random.default_rng(seed)
        rides, each = cars * days * 2, 4
        n = rides * each
        self.ride = np.repeat(np.arange(rides), each)
        self.day = np.arange(rides) // 2
        self.car = np.arange(cars * days) // days
        self.design = rng.gamma(2.0, 1.0, (n, 3))
        self.shared = np.column_stack([self.design[:, 0], rng.uniform(0.5, 1.5, n)])
        self.variance = rng.uniform(0.5, 2.0, n) * 0.1
        levels = (
            (self.ride, self.shared, (spreads.ride_drive, spreads.ride_power)),
            (self.day[self.ride], self.shared, (spreads.day_drive, spreads.day_power)),
            (self.car[self.day[self.ride]], (self.design @ GUESS)[:, np.newaxis], (spreads.car,)),
        )
        self.covariance = np.diag(spreads.row**2 * self.variance)
        for code, columns, sd in levels:
            same = code[:, np.newaxis] == code
            self.covariance += same * ((columns * np.square(sd)) @ columns.T)
        root = np.linalg.cholesky(self.covariance)
        self.energy = self.design @ np.array([1.2, 0.6, 0.1]) + root @ rng.normal(size=n)

    def products(self) -> RideProducts:
        table = np.column_stack([self.design, self.energy, self.shared, self.design @ GUESS])
        rides = len(self.day)
        sums = sum_products(table, 1.0 / self.variance, self.ride, rides)
        return RideProducts(sums, np.bincount(self.ride), self.day, self.car)


def test_elimination_equals_generalised_least_squares():
    rows = Rows()
    elimination = eliminate(rows.products(), SPREADS)
    total = without_car_factor(elimination.cars, SPREADS.car)[0].sum(axis=0)
    posterior = compute_coefficients(PRIOR, total)
    inverse = np.linalg.inv(rows.covariance)
    precision = np.linalg.inv(PRIOR.covariance)
    covariance = np.linalg.inv(rows.design.T @ inverse @ rows.design + precision)
    mean = covariance @ (rows.design.T @ inverse @ rows.energy + precision @ PRIOR.mean)
    np.testing.assert_allclose(posterior.mean, mean, rtol=1e-9)
    np.testing.assert_allclose(posterior.covariance, covariance, rtol=1e-8)


def test_evidence_differs_between_spreads_as_the_gaussian_density_does():
    def density(spreads: LevelSpreads) -> float:
        rows = Rows(spreads=spreads)
        whole = rows.covariance + rows.design @ PRIOR.covariance @ rows.design.T
        left = Rows().energy - rows.design @ PRIOR.mean
        return -0.5 * float(left @ np.linalg.solve(whole, left) + np.linalg.slogdet(whole)[1])

    other = LevelSpreads(1.3, 0.1, 0.4, 0.05, 0.3, 0.02)
    difference = compute_level_evidence(Rows().products(), PRIOR, SPREADS) - compute_level_evidence(
        Rows().products(), PRIOR, other
    )
    assert difference == pytest.approx(density(SPREADS) - density(other), rel=1e-8)


def test_sums_of_a_part_equal_sums_of_the_rest():
    rows = Rows()
    products = rows.products()
    elimination = eliminate(products, SPREADS)
    kept = rows.day != 4
    part = RideProducts(products.sums[kept], products.rows[kept], np.arange(8).repeat(2), np.delete(rows.car, 4))
    rest = elimination.cars[1] - elimination.days[4]
    np.testing.assert_allclose(eliminate(part, SPREADS).cars[1], rest, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("cars", [True, False])
def test_planted_spreads_are_estimated(cars):
    truth = LevelSpreads(1.0, 0.1, 0.3, 0.08, 0.25, 0.05 if cars else 0.0)
    rows = Rows(seed=3, days=60, cars=6, spreads=truth)
    found = estimate_spreads(rows.products(), PRIOR, cars=cars)
    assert found.row == pytest.approx(1.0, abs=0.1)
    assert found.ride_power == pytest.approx(0.3, rel=0.35)
    assert found.day_power == pytest.approx(0.25, rel=0.4)
    assert (found.car > 0.0) == cars


def test_thinned_products_keep_whole_days():
    products = Rows(days=40).products()
    some = products.thinned(60)
    assert 58 <= len(some.rows) <= 62
    assert (np.bincount(some.day) == 2).all()
    assert products.thinned(10_000) is products
    assert EXPECTED_LEVELS.row == 1.0
