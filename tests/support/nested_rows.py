"""Make rows whose errors are correlated within rides, vehicle-days and cars, with their whole covariance."""

import numpy as np

from socast.core.fit.nested_effects import Gaussian, LevelSpreads, RideProducts
from socast.core.stats.random_effects import sum_products

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
        sums = sum_products(table, 1.0 / self.variance, self.ride)
        return RideProducts(sums, np.bincount(self.ride), self.day, self.car)
