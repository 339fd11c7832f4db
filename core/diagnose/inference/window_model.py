"""Evaluate the marginal likelihood of windows under a linear mixed model, and learn the spreads of its random effects.

The energy of window w of ride r of car c on date t is

    y_w = x_w'b + z_w'(u_r + u_rc + u_c + u_t) + e_w,    e_w ~ N(0, v_w),    b ~ N(0, 1),    u ~ N(0, spread^2),

with one effect u on each shape for each ride, vehicle-day, car and date. Effects of rides and vehicle-days are
integrated out of the sums of products of each ride and day; those of cars and dates are columns of one linear system
beside b. The logarithms of the spreads, over their usual values, have a normal prior of standard deviation `HYPER`, and
are learned by maximising the marginal likelihood. Windows of large residual have less weight.

References
----------
Laird and Ware, Biometrics 38 (1982) 963, DOI 10.2307/2529876.
"""

from collections.abc import Sequence
from copy import copy
from dataclasses import replace
from itertools import pairwise
from math import log
from typing import Final, NamedTuple

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import minimize
from scipy.sparse import csc_array, csr_array

from socast.core.batch import Floats, Ints
from socast.core.diagnose.inference.window_columns import CAR_DIRECTIONS, SHAPES, WindowColumns
from socast.core.fit.row_noise import compute_robust_weights, estimate_variance
from socast.core.stats.random_effects import Integrated, SweepStep, integrate_out, sum_products

HYPER: Final = 0.7
"""Standard deviation of the logarithm of a spread about its usual value."""
WIDEST: Final = (-4.0, 3.0)
"""Range of that logarithm."""
LEAST_DATES: Final = 1.3
"""Vehicle-days per date above which dates have random effects of their own."""
FIRST_VARIANCE: Final = 0.1
"""Variance of a window over that of the residual, before it is estimated. [1]"""
ROUNDS: Final = 2
"""Number of times that the variance of the windows is estimated anew."""
STEPS: Final = 8
"""Number of steps of the search for the spreads."""
S, D = len(SHAPES), len(CAR_DIRECTIONS)
RIDES, DAYS, CARS, DATES = slice(0, S), slice(S, 2 * S), slice(2 * S, 3 * S + D), slice(3 * S + D, 4 * S + D)
"""Places of the logarithms of the spreads of each level."""


class _Sums(NamedTuple):
    """Hold weighted sums of products of q columns.

    Parameters
    ----------
    rides : (r, S, q) float
        Of each ride, with its loads.
    days : (d, q, q) float
        Of each vehicle-day, with each other.
    """

    rides: Floats
    days: Floats


class WindowModel:
    """Hold windows, the variance of each, and the spreads of the random effects.

    Parameters
    ----------
    known : (n, k) float
        Energy of effects that are taken to exist, per standard deviation of their coefficient. [kWh]

    Attributes
    ----------
    widening : (e,) float
        Factor by which the prior of each expected effect is wider than declared, because its coefficient lies far from
        the prior mean: the prior has the tails of a Cauchy distribution, within the plausible range.
    log_spread : (4 S + D,) float
        Logarithm of the spread of each level and shape over its usual value.
    variance, weight : (n,) float
        Variance of each window [kWh^2], and its weight, below 1 for outliers.
    size : int
        Number F of coefficients of the linear system.
    """

    def __init__(self, columns: WindowColumns) -> None:
        n = len(columns.residual)
        self.columns, self.known = columns, np.zeros((n, 0))
        self.log_spread = np.zeros(DATES.stop)
        self.widening = np.ones(len(columns.expected))
        counted = ~columns.ignored
        self.variance = np.full(n, max(FIRST_VARIANCE * float(np.var(columns.residual[counted])), 1e-12))
        self.weight = counted.astype(np.float64)
        kinds = [columns.kind_of_day[columns.car_of_day == car][0] for car in range(len(columns.cars))]
        self.has_cars = bool(np.bincount(kinds).max() > 1)
        self._by_day = np.argsort(columns.day_of_ride, kind="stable")
        edges = np.r_[0, np.cumsum(np.bincount(columns.day_of_ride))].tolist()
        self._rides_of_day = [slice(start, stop) for start, stop in pairwise(edges)]
        self.has_dates = len(columns.cars) > 1 and len(columns.start) > LEAST_DATES * len(columns.dates)
        self._place_columns()
        for _ in range(ROUNDS):
            self._solve()
            self._estimate_noise()
        self._solve()

    def add(self, known: Floats) -> "WindowModel":
        """Return the model beside other known effects, with the same variances and spreads."""
        other = copy(self)
        other.known = known
        other._place_columns()  # noqa: SLF001
        other._solve()  # noqa: SLF001
        return other

    def relearn(self, steps: int = STEPS) -> "WindowModel":
        """Return the model with variances and spreads learned anew."""
        other = copy(self)
        other._estimate_noise()  # noqa: SLF001
        other._solve()  # noqa: SLF001
        return other.relearn_spreads(steps)

    def relearn_spreads(self, steps: int = STEPS) -> "WindowModel":
        """Return the model with spreads, and a common factor of all variances, learned anew."""
        other = copy(self)
        found = minimize(
            other._evaluate,  # noqa: SLF001
            np.append(other.log_spread, 0.0),
            jac=True,
            method="L-BFGS-B",
            bounds=[WIDEST] * len(other.log_spread) + [(-3.0, 3.0)],
            options={"maxiter": steps, "ftol": 1e-8},
        )
        other.log_spread, other.variance = found.x[:-1], other.variance * np.exp(found.x[-1])
        other._solve()  # noqa: SLF001
        return other

    def shift(self, energy: Floats) -> "WindowModel":
        """Return the model of windows that use more energy, with the same variances and spreads. [kWh]"""
        other = copy(self)
        other.columns = replace(self.columns, residual=self.columns.residual + energy)
        other._solve()  # noqa: SLF001
        return other

    def replace_columns(self, columns: WindowColumns) -> "WindowModel":
        """Return the model with other columns that may be missing."""
        other = copy(self)
        other.columns = columns
        return other

    def weigh(self, column: Floats) -> float:
        """Return the log evidence of a further column whose coefficient is standard normal, against none."""
        both = self.add(np.column_stack([self.known, column]))
        at = both.locate_known().stop - 1
        variance = float(both.covariance()[at, at])
        return 0.5 * (log(variance) + float(both.coefficients[at]) ** 2 / variance)

    @property
    def log_density(self) -> float:
        """Logarithm of the density of the energies and the spreads, up to a constant."""
        value, _ = self._evaluate(np.append(self.log_spread, 0.0))
        return -value - 0.5 * float(np.log(self.variance).sum())

    def sum_days(self, more: Floats) -> Floats:
        """Return the sums of each vehicle-day of all columns and of further ones, without effects of rides and days.

        Parameters
        ----------
        more : (n, k) float
            Further columns, which stand between the known effects and the energy.

        Returns
        -------
        (d, q, q) float
            Sums of products.
        """
        _, of_days = self._integrate(self.log_spread, self._sum(self.columns.stack(self.known, more)))
        return of_days.sums

    def prepare_products(self) -> "FurtherProducts":
        """Return what multiplies further columns with themselves, and with the coefficients and the energy."""
        columns = self.columns
        weight = (self.weight / self.variance)[:, np.newaxis]
        loads = weight * columns.shapes
        levels = []
        for unit, inner in (
            (columns.ride, self.of_rides.inner),
            (columns.day, self.of_days.inverse * self.of_days.variance),
        ):
            own, beside = _place_loads(columns.shapes, unit), _place_loads(loads, unit).T
            levels.append((own, beside, inner))
            loads = loads - beside @ (inner @ (own @ loads).reshape(-1, S, S)).reshape(-1, S)
        values = columns.stack(self.known)[:, self._source]
        starts = np.arange(0, values.size + 1, len(self._source))
        places = self._place[columns.day].ravel()
        system = csr_array((values.ravel(), places, starts), (len(values), self.size + 1))
        return FurtherProducts(weight, levels, system.T, self.scale[:, np.newaxis])

    @property
    def coordinates(self) -> tuple[Ints, Ints]:
        """Columns of the sums that the linear system has, (w,), and the coefficient of each on each day, (d, w)."""
        return self._source, self._place

    @property
    def scale(self) -> Floats:
        """Spread of each coefficient of the system, and 1 for the energy, (F + 1,)."""
        return self._scale(self.log_spread)

    def assemble(self, sums: Floats) -> Floats:
        """Return the sums of days at the places of the coefficients and, last, of the energy, (F + 1, F + 1)."""
        return np.asarray(self._adding @ sums.ravel()).reshape(self.size + 1, -1)

    def locate_known(self) -> slice:
        """Return the places of the known effects among the coefficients."""
        end = self._shared + self.columns.common.shape[1]
        return slice(end, end + self.known.shape[1])

    @property
    def shared(self) -> int:
        """Place of the first common column among the coefficients."""
        return self._shared

    @property
    def car_effects(self) -> slice:
        """Places of the random effects of cars, shapes and directions of each."""
        return slice(self._cars_at, self._dates_at)

    def covariance(self) -> Floats:
        """Return the covariance of the coefficients beside each other, in their units of one spread, (F, F)."""
        return np.asarray(cho_solve(self._factor, np.eye(self.size)))

    # ---- sums and the linear system

    def _sum(self, stacked: Floats) -> _Sums:
        """Return the weighted sums of products of columns."""
        columns, weight = self.columns, self.weight / self.variance
        rides = _place_loads(columns.shapes * weight[:, np.newaxis], columns.ride) @ stacked
        return _Sums(rides.reshape(-1, S, stacked.shape[1]), sum_products(stacked, weight, columns.day))

    def _integrate(self, log_spread: Floats, sums: _Sums) -> tuple[SweepStep, Integrated]:
        """Return the integration over the effects of rides and of vehicle-days."""
        rides = SweepStep.of(sums.rides[:, :, :S], sums.rides, np.exp(2.0 * log_spread[RIDES]))
        beside, gain = (each[self._by_day].reshape(-1, sums.days.shape[1]) for each in (rides.beside, rides.gain))
        days = np.empty_like(sums.days)
        for day, own in enumerate(self._rides_of_day):
            rows = slice(S * own.start, S * own.stop)
            np.subtract(sums.days[day], beside[rows].T @ gain[rows], out=days[day])
        return rides, integrate_out(days, slice(0, S), np.exp(2.0 * log_spread[DAYS]))

    def _solve(self) -> None:
        """Compute the sums, and the coefficients at the current spreads."""
        self._sums = self._sum(self.columns.stack(self.known))
        self.of_rides, self.of_days = self._integrate(self.log_spread, self._sums)
        scale = self.scale
        self.total = self.assemble(self.of_days.sums) * np.outer(scale, scale)
        size = self.size
        self._factor = cho_factor(np.eye(size) + self.total[:size, :size], lower=True)
        self.coefficients = cho_solve(self._factor, self.total[:size, size])

    def _place_columns(self) -> None:
        """Assign a place to each coefficient: base by model, common and known columns, effects of cars and of dates."""
        columns, days = self.columns, len(self.columns.start)
        base, common = columns.base.shape[1], columns.common.shape[1] + self.known.shape[1]
        source, place, at = [], [], 0
        for k in range(base):
            source.append(S + D + k)
            place.append(columns.kind_of_day * base + k)
        at = base * (int(columns.kind_of_day.max()) + 1)
        self._shared = at
        for k in range(common):
            source.append(S + D + base + k)
            place.append(np.full(days, at + k))
        self._expected_at = [at + each.at for each in columns.expected]
        self._cars_at = at = at + common
        if self.has_cars:
            for k in range(S + D):
                source.append(k)
                place.append(at + columns.car_of_day * (S + D) + k)
            at += (S + D) * len(columns.cars)
        self._dates_at = at
        if self.has_dates:
            for k in range(S):
                source.append(k)
                place.append(at + columns.date_of_day * S + k)
            at += S * len(columns.dates)
        self.size = at
        source.append(S + D + base + common)
        place.append(np.full(days, at))
        self._source, self._place = np.array(source), np.stack(place, axis=1)
        q = S + D + base + common + 1
        here = self._source[:, np.newaxis] * q + self._source + q * q * np.arange(days)[:, np.newaxis, np.newaxis]
        there = self._place[:, :, np.newaxis] * (at + 1) + self._place[:, np.newaxis, :]
        shape = (at + 1) ** 2, days * q * q
        self._adding = csr_array((np.ones(here.size), (there.ravel(), here.ravel())), shape)

    def _scale(self, log_spread: Floats) -> Floats:
        """Return the spread of each coefficient, and 1 for the energy."""
        scale = np.ones(self.size + 1)
        scale[self._expected_at] = self.widening
        scale[self._cars_at : self._dates_at] = np.tile(
            np.exp(log_spread[CARS]), len(self.columns.cars) if self.has_cars else 0
        )
        scale[self._dates_at : self.size] = np.tile(
            np.exp(log_spread[DATES]), len(self.columns.dates) if self.has_dates else 0
        )
        return scale

    # ---- noise and spreads

    def compute_residual(self) -> Floats:
        """Return what the base, the known effects and all random effects leave of each window. [kWh]"""
        width = self._sums.days.shape[1]
        weights = np.zeros((len(self.columns.start), width))
        by_place = np.append(-self.coefficients * self.scale[:-1], 1.0)
        for source, place in zip(self._source, self._place.T, strict=True):
            weights[:, source] += by_place[place]
        of_days = np.einsum("dkq,dq->dk", self.of_days.gain, weights)
        of_ride = weights[self.columns.day_of_ride]
        of_ride[:, :S] -= of_days[self.columns.day_of_ride]
        of_ride[:, :S] -= np.einsum("rkq,rq->rk", self.of_rides.gain, of_ride)
        return np.einsum("nq,nq->n", self.columns.stack(self.known), of_ride[self.columns.ride])

    def _estimate_noise(self) -> None:
        """Estimate the variance of each window from its residual, its weight, and the priors of expected effects."""
        residual = self.compute_residual()
        variance = np.diag(self.covariance())[self._expected_at]
        squares = (self.coefficients[self._expected_at] ** 2 + variance) * self.widening**2
        widest = np.array([each.widest for each in self.columns.expected])
        self.widening = np.clip(np.sqrt(0.5 + 0.5 * squares), 1.0, widest)
        counted = ~self.columns.ignored
        self.variance = np.full(len(residual), 1.0)
        self.variance[counted] = estimate_variance(self.columns.parts[counted], residual[counted])
        self.weight = np.zeros(len(residual))
        self.weight[counted] = compute_robust_weights(residual[counted] / np.sqrt(self.variance[counted])) ** 2

    def _evaluate(self, parameters: Floats) -> tuple[float, Floats]:
        """Return minus the log density and its gradient at log spreads and the log of a factor of all variances."""
        log_spread, factor = parameters[:-1], parameters[-1]
        sums = _Sums(*(each * np.exp(-factor) for each in self._sums))
        rides, days = self._integrate(log_spread, sums)
        scale, size, n = self._scale(log_spread), self.size, float((self.weight > 0.0).sum())
        total = self.assemble(days.sums) * np.outer(scale, scale)
        lower = cho_factor(np.eye(size) + total[:size, :size], lower=True)
        found = cho_solve(lower, total[:size, size])
        value = 0.5 * float(total[size, size] - total[:size, size] @ found) + float(np.log(np.diag(lower[0])).sum())
        value += 0.5 * (rides.log_determinant + float(days.log_determinant.sum()) + n * factor)
        value += 0.5 * float(((log_spread / HYPER) ** 2).sum())
        inverse = cho_solve(lower, np.eye(size))
        by_spread = log_spread / HYPER**2
        excess = 1.0 - found**2 - np.diag(inverse)
        if self.has_cars:
            by_spread[CARS] += excess[self._cars_at : self._dates_at].reshape(-1, S + D).sum(axis=0)
        if self.has_dates:
            by_spread[DATES] += excess[self._dates_at :].reshape(-1, S).sum(axis=0)
        outer = np.append(-found, 1.0)
        by_total = -0.5 * np.outer(outer, outer)
        by_total[:size, :size] -= 0.5 * inverse
        by_total *= np.outer(scale, scale)
        by_sums = np.asarray(self._adding.T @ by_total.ravel()).reshape(days.sums.shape)
        by_days, by_variance = days.pass_back(by_sums)
        by_spread[DAYS] -= 2.0 * by_variance * np.exp(2.0 * log_spread[DAYS])
        beside, by_total = rides.beside[self._by_day], -2.0 * by_days
        times = np.empty_like(beside)
        for day, own in enumerate(self._rides_of_day):
            times[self._by_day[own]] = beside[own] @ by_total[day]
        by_variance, by_own, by_beside = rides.pass_back(times, None, None)
        by_spread[RIDES] += by_variance * np.exp(2.0 * log_spread[RIDES])
        by_factor = float(np.vdot(by_days, sums.days)) + 0.5 * n
        by_factor -= 0.5 * float((by_own * rides.own).sum() + (by_beside * rides.beside).sum())
        return value, np.append(by_spread, by_factor)


class FurtherProducts(NamedTuple):
    """Hold what all products of further columns need: weights, loads of rides and days, and the other columns."""

    weight: Floats
    levels: Sequence[tuple[csc_array, csr_array, Floats]]
    system: csc_array
    scale: Floats

    def multiply(self, further: Floats) -> tuple[Floats, Floats]:
        """Return products of further columns with themselves, and with the coefficients and the energy.

        Parameters
        ----------
        further : (n, m) float
            Columns. [kWh]

        Returns
        -------
        (m,), (F + 1, m) float
            Products, without effects of rides and days.
        """
        left = self.weight * further
        for own, beside, inner in self.levels:
            expected = (inner @ (own @ left).reshape(-1, S, left.shape[1])).reshape(-1, left.shape[1])
            left = left - beside @ expected
        return np.einsum("nm,nm->m", further, left), (self.system @ left) * self.scale


def _place_loads(loads: Floats, unit: Ints) -> csc_array:
    """Return the loads of windows as a matrix of the loads of each unit by windows, (units S, n)."""
    rows = (unit[:, np.newaxis] * S + np.arange(S)).ravel()
    shape = (int(unit.max()) + 1) * S, len(loads)
    return csc_array((loads.ravel(), rows, np.arange(0, loads.size + 1, S)), shape)
