"""Fit the accessory curve of Figure 1: its choke points and levels, by least squares; and soften it for other fits.

The product w P(T) explains the energy of a ride that the road load does not explain. Here w is the running time of the
accessories, scaled by the car, and P(T) is their power at the outside temperature T.

P has five segments. At given choke points P is linear in its three levels, so an inner linear problem yields the
levels. The outer solver moves only the choke points: variable projection [1]_. The inner problem can also yield the
coefficients of the road load.

The fit first sums rides in narrow bins of temperature and keeps each bin as the triangular factor of its rows. P is a
straight line within a bin, so the binning is exact except in the four bins where P bends. The work of the solver
therefore does not grow with the number of rides.

Fits to windows take the mean of P over half a degree on either side (`SOFTENED`), because outside temperature is known
to about as much. The error of a fit has a corner wherever a choke point passes the temperature of a ride, and the best
choke point may be at such a corner, where derivatives tell nothing. The mean is smooth.

References
----------
.. [1] Golub, Pereyra 1973, SIAM J. Numer. Anal. 10:413, DOI 10.1137/0710036.
"""

from collections.abc import Sequence
from functools import lru_cache
from itertools import combinations
from typing import Any, Final, NamedTuple

import numpy as np
from scipy.optimize import least_squares, nnls

from socast.core.batch import Floats, Ints
from socast.core.columns import ZERO_CELSIUS
from socast.core.vehicles import ACCESSORIES, AccessoryCurve

SOFTENED: Final = 0.5
"""Half the range of temperatures over which the power is averaged. [K]"""
LEVELS: Final = ("standby", "heating", "cooling")
"""Levels of the accessory curve, in the order of `compute_slopes`."""
CHOKE_POINTS: Final = ("heating_full", "heating_off", "cooling_on", "cooling_full")
"""Choke points of the accessory curve, ascending."""
CURVE_NUMBERS: Final = len(LEVELS) + len(CHOKE_POINTS)
"""Number of parameters of an accessory curve."""
_LOW, _HIGH, _WIDTH = -60.0, 60.0, 0.25
"""Range and width of the bins of outside temperature. [°C]"""
_BINS: Final = round((_HIGH - _LOW) / _WIDTH)
_CENTRE: Final[Floats] = _LOW + _WIDTH * (np.arange(_BINS, dtype=np.float64) + 0.5)
LEAST_GAP: Final = 1.0
"""Smallest distance between two choke points. [K]"""
_LEAST_RIDES: Final = 70
"""Fewest rides for a fit of the curve: ten for each of its numbers. With fewer, the fit scales the reference curve."""
_LEAST_SPREAD: Final = 10.0
"""Smallest range of temperatures that determines five segments. Over less, the fit scales the reference curve. [K]"""
_GRID: Final = 1.0
"""Finest step of the grid from which the solver starts. [K]"""
_GRID_POINTS: Final = 24
_STARTS: Final = 4
"""Number of grid points from which the solver starts. Each is the best point that is no neighbour of those before."""


class TemperatureBins:
    """Sum products of the columns of rides, by outside temperature.

    Parameters
    ----------
    beside : int
        Number of columns whose coefficients are fitted together with the curve.
    """

    def __init__(self, beside: int = 0) -> None:
        self.beside = beside
        self.rides = 0
        self.sums: Floats = np.zeros((_BINS, 3 + beside, 3 + beside))

    def add(self, ambient_c: Floats, time: Floats, energy: Floats, columns: Sequence[Floats] = ()) -> None:
        """Add rides, except those with an unknown value.

        Units: energy [kWh], columns [kWh].

        Parameters
        ----------
        time : (n,) float
            Duration times the car's accessory scale, over 3.6e6. Its product with a power in W is an energy in kWh.
        """
        table = np.stack([time, time, *columns, energy])
        known = np.isfinite(ambient_c) & np.isfinite(table).all(axis=0)
        table, ambient = table[:, known], ambient_c[known]
        self.rides += len(ambient)
        place = np.clip(((ambient - _LOW) / _WIDTH).astype(np.int64), 0, _BINS - 1)
        table[1] *= ambient - _CENTRE[place]
        for i in range(len(table)):
            for j in range(i, len(table)):
                self.sums[:, i, j] += np.bincount(place, table[i] * table[j], _BINS)

    def merge(self, other: "TemperatureBins") -> None:
        """Add the rows of other bins."""
        self.rides += other.rides
        self.sums += other.sums

    def __getstate__(self) -> tuple[int, int, Ints, Floats]:
        """Return the bins that hold rows, as few of many do."""
        used = np.flatnonzero(self.sums.any(axis=(1, 2)))
        return self.beside, self.rides, used, self.sums[used]

    def __setstate__(self, state: tuple[int, int, Ints, Floats]) -> None:
        """Take the bins that hold rows."""
        beside, rides, used, sums = state
        self.__init__(beside)  # type: ignore[misc]
        self.rides, self.sums[used] = rides, sums

    def fit(self) -> AccessoryCurve:
        """Return the accessory curve of least squares.

        Returns
        -------
        AccessoryCurve
            The scaled reference curve where the rides are too few or their temperatures too similar.
        """
        return _fit(self.sums.tobytes(), self.beside, self.rides >= _LEAST_RIDES)


def flatten_curve(curve: AccessoryCurve) -> Floats:
    """Return the seven numbers of a curve."""
    return np.array([getattr(curve, name) for name in (*LEVELS, *CHOKE_POINTS)])


def build_curve(numbers: Floats) -> AccessoryCurve:
    """Return the curve of seven numbers, see `flatten_curve`."""
    return AccessoryCurve(**dict(zip((*LEVELS, *CHOKE_POINTS), numbers.tolist(), strict=True)))


def compute_curve_columns(curve: AccessoryCurve, ambient_c: Floats) -> Floats:
    """Return the derivatives of the accessory power by the seven numbers of its curve.

    Units: returns [W/K].
    """
    slopes = compute_slopes(curve, ambient_c)
    slopes[:, 0] -= slopes[:, 1] + slopes[:, 2]  # there, heating and cooling count from standby
    return slopes


def compute_slopes(curve: AccessoryCurve, ambient_c: Floats) -> Floats:
    """Return the derivatives of the accessory power by the seven numbers of the curve."""
    knots = np.array([curve.heating_full, curve.heating_off, curve.cooling_on, curve.cooling_full]) - ZERO_CELSIUS
    (standby, heat, cool), (_, d_heat, d_cool) = _shape(knots, ambient_c)
    by_heat = (curve.heating - curve.standby) * d_heat
    by_cool = (curve.cooling - curve.standby) * d_cool
    moved = (-heat * by_heat, -(1.0 - heat) * by_heat, -(1.0 - cool) * by_cool, -cool * by_cool)
    return np.stack([standby, heat, cool, *moved], axis=1)


class _BinFactors(NamedTuple):
    """Hold the input of the solver.

    Parameters
    ----------
    centre : (b,) float. Centres of the bins that hold rides. [°C]
    factors : (b, k, k) float. Triangular factors of the rows of each bin: w, w (T - centre), columns, energy.
    projection : (b k, beside) float. Orthonormal basis of the columns.
    target : (b k,) float. Energy that the columns cannot explain. [kWh]
    """

    centre: Floats
    factors: Floats
    projection: Floats
    target: Floats


@lru_cache(maxsize=256)
def _fit(content: bytes, beside: int, enough: bool) -> AccessoryCurve:
    """Return the curve for sums of bins; cached, as recipes that share a curve request it one after the other."""
    sums = np.frombuffer(content).reshape(_BINS, 3 + beside, 3 + beside)
    sums = sums + np.triu(sums, 1).transpose(0, 2, 1)
    used = np.flatnonzero(sums[:, 0, 0] > 0.0)
    if not enough or (used[-1] - used[0]) * _WIDTH < _LEAST_SPREAD:
        return _scaled(sums)
    low, high = float(_CENTRE[used[0]]), float(_CENTRE[used[-1]])
    binned = _binned(sums[used], _CENTRE[used])
    starts = _starts(sums[used], _CENTRE[used], low, high)
    best = min((_solved(start, binned, low, high) for start in starts), key=lambda result: float(result.cost))
    knots = _knots(best.x, low, high)
    standby, heating, cooling = _levels(knots, binned)[0]
    return build_curve(np.array([standby, standby + heating, standby + cooling, *(knots + ZERO_CELSIUS)]))


def _scaled(sums: Floats) -> AccessoryCurve:
    """Return the reference curve times a factor fitted by least squares, with 1 as coefficient of each column."""
    off = np.divide(sums[:, 0, 1], sums[:, 0, 0], out=np.zeros(_BINS), where=sums[:, 0, 0] > 0.0)
    power = ACCESSORIES.power(_CENTRE + off + ZERO_CELSIUS)
    squares = float(sums[:, 0, 0] @ power**2)
    left = sums[:, 0, -1] - sums[:, 0, 2:-1].sum(axis=1)
    numbers = flatten_curve(ACCESSORIES)
    numbers[: len(LEVELS)] *= max(float(left @ power) / squares, 0.0) if squares > 0.0 else 1.0
    return build_curve(numbers)


def _binned(sums: Floats, centre: Floats) -> _BinFactors:
    """Return the triangular factors of the bins, and the energy that the columns do not explain."""
    factors = _factors(sums)
    bins, k, _ = factors.shape
    columns = factors[:, :, 2:-1].reshape(bins * k, k - 3)
    target = factors[:, :, -1].reshape(bins * k)
    size = np.sqrt((columns**2).sum(axis=0))
    vectors, values, _ = np.linalg.svd(columns / np.where(size > 0.0, size, 1.0), full_matrices=False)
    projection = vectors[:, values > 1e-6]
    return _BinFactors(centre, factors, projection, target - projection @ (projection.T @ target))


def _factors(sums: Floats) -> Floats:
    """Return upper Cholesky factors of sums of products, zero where a column depends on those before it."""
    left = sums.copy()
    factor = np.zeros_like(sums)
    for i in range(sums.shape[1]):
        squares = left[:, i, i]
        pivot = np.where(squares > 1e-12 * sums[:, i, i], np.sqrt(np.maximum(squares, 0.0)), 0.0)
        by = pivot[:, np.newaxis]
        row = np.divide(left[:, i], by, out=np.zeros(left.shape[:2]), where=by > 0.0)
        row[:, :i] = 0.0
        factor[:, i] = row
        left -= row[:, :, np.newaxis] * row[:, np.newaxis, :]
    return factor


def _shape(knots: Floats, centre: Floats) -> tuple[Floats, Floats]:
    """Return the shares of standby, heating and cooling in the power at each temperature, and their slopes; (3, b)."""
    t1, t2, t3, t4 = knots
    heat = np.clip((t2 - centre) / (t2 - t1), 0.0, 1.0)
    cool = np.clip((centre - t3) / (t4 - t3), 0.0, 1.0)
    d_heat = np.where((centre > t1) & (centre < t2), -1.0 / (t2 - t1), 0.0)
    d_cool = np.where((centre > t3) & (centre < t4), 1.0 / (t4 - t3), 0.0)
    return np.stack([np.ones(len(centre)), heat, cool]), np.stack([np.zeros(len(centre)), d_heat, d_cool])


def _levels(knots: Floats, binned: _BinFactors) -> tuple[Floats, Floats]:
    """Return the non-negative levels [W] of least squares at given choke points, and the residuals [kWh]."""
    level, slope = _shape(knots, binned.centre)
    time, off = binned.factors[:, :, 0, np.newaxis], binned.factors[:, :, 1, np.newaxis]
    table = (time * level.T[:, np.newaxis] + off * slope.T[:, np.newaxis]).reshape(-1, 3)
    table = table - binned.projection @ (binned.projection.T @ table)
    size = np.sqrt((table**2).sum(axis=0))
    size = np.where(size > 0.0, size, 1.0)
    table = table / size
    levels = np.linalg.lstsq(table.T @ table, table.T @ binned.target, rcond=1e-10)[0]
    if (levels < 0.0).any():
        levels = nnls(table, binned.target)[0]
    return levels / size, binned.target - table @ levels


def _knots(x: Floats, low: float, high: float) -> Floats:
    """Return choke points between two temperatures; each share divides the range that remains above the last. [°C]"""
    knots = np.empty(4)
    at = low - LEAST_GAP
    for i, share in enumerate(x):
        at += LEAST_GAP
        at += share * (high - at - LEAST_GAP * (3 - i))
        knots[i] = at
    return knots


def _shares(knots: Floats, low: float, high: float) -> Floats:
    """Return the shares that `_knots` converts into these choke points."""
    before = np.concatenate([[low - LEAST_GAP], knots[:-1]]) + LEAST_GAP
    left = high - before - LEAST_GAP * np.arange(3, -1, -1)
    return np.clip((knots - before) / np.maximum(left, 1e-9), 0.001, 0.999)


def _starts(sums: Floats, centre: Floats, low: float, high: float) -> list[Floats]:
    """Return the best points of a coarse grid of choke points, as shares for `_knots`."""
    weight, cross = sums[:, 0, 0], _left(sums, centre)
    grid = np.arange(low, high + 1e-9, max(_GRID, (high - low) / _GRID_POINTS))
    pairs = np.array(list(combinations(range(len(grid)), 2)))
    ramps = np.array([np.clip((centre - grid[a]) / (grid[b] - grid[a]), 0.0, 1.0) for a, b in pairs])
    heat, cool = 1.0 - ramps, ramps
    both = (heat * weight) @ cool.T
    cold, hot = np.nonzero(pairs[:, 1, np.newaxis] < pairs[np.newaxis, :, 0])
    gram = np.empty((len(cold), 3, 3))
    gram[:, 0, 0] = weight.sum()
    gram[:, 0, 1] = gram[:, 1, 0] = (heat @ weight)[cold]
    gram[:, 0, 2] = gram[:, 2, 0] = (cool @ weight)[hot]
    gram[:, 1, 1] = ((heat**2) @ weight)[cold]
    gram[:, 2, 2] = ((cool**2) @ weight)[hot]
    gram[:, 1, 2] = gram[:, 2, 1] = both[cold, hot]
    right = np.stack([np.full(len(cold), cross.sum()), (heat @ cross)[cold], (cool @ cross)[hot]], axis=1)
    gram += 1e-9 * weight.sum() * np.eye(3)
    levels = np.linalg.solve(gram, right[..., np.newaxis])[..., 0]
    gain = np.where((levels >= 0.0).all(axis=1), (levels * right).sum(axis=1), -np.inf)
    places = np.concatenate([pairs[cold], pairs[hot]], axis=1)
    best: list[int] = []
    while len(best) < _STARTS and np.isfinite(gain).any():
        best.append(int(np.argmax(gain)))
        gain[np.abs(places - places[best[-1]]).max(axis=1) <= 2] = -np.inf
    return [_shares(grid[places[k]], low, high) for k in best] or [np.full(4, 0.25)]


def _left(sums: Floats, centre: Floats) -> Floats:
    """Return each bin's sum of w times the residual of the columns, fitted with a free power for each 3 K."""
    beside = sums.shape[1] - 3
    if not beside:
        return sums[:, 0, -1]
    place = ((centre - centre[0]) / 3.0).astype(np.int64)
    free = place[-1] + 1
    gram, right = np.zeros((free + beside,) * 2), np.zeros(free + beside)
    gram[np.arange(free), np.arange(free)] = np.bincount(place, sums[:, 0, 0], free)
    for j in range(beside):
        gram[:free, free + j] = gram[free + j, :free] = np.bincount(place, sums[:, 0, 2 + j], free)
    gram[free:, free:] = sums[:, 2:-1, 2:-1].sum(axis=0)
    right[:free] = np.bincount(place, sums[:, 0, -1], free)
    right[free:] = sums[:, 2:-1, -1].sum(axis=0)
    scale = np.sqrt(np.diag(gram))
    scale = np.where(scale > 0.0, scale, 1.0)
    solved = np.linalg.lstsq(gram / np.outer(scale, scale), right / scale, rcond=1e-10)[0] / scale
    return sums[:, 0, -1] - sums[:, 0, 2:-1] @ solved[free:]


def _solved(start: Floats, binned: _BinFactors, low: float, high: float) -> Any:
    """Return the result of scipy from one start, with choke points between the coldest and the warmest ride."""
    return least_squares(
        lambda x: _levels(_knots(x, low, high), binned)[1],
        start,
        bounds=(0.0, 1.0),
        diff_step=1e-4,
        xtol=1e-7,
        ftol=1e-10,
    )


class SoftenedPower(NamedTuple):
    """Hold the mean accessory power about n temperatures, and its derivatives by the numbers of the curve.

    Parameters
    ----------
    power : (n,) float
        Mean power over temperatures within `SOFTENED`. [W]
    first : (n, 7) float
        Derivatives by the levels [1] and by the choke points [W/K], in the order of
        `flatten_curve`.
    second : (n, 7, 7) float
        Second derivatives.
    """

    power: Floats
    first: Floats
    second: Floats


class _Share(NamedTuple):
    """Hold the share of a level in the power: 0 where `far` is 0, 1 where `near` is 0, and its derivatives by both."""

    value: Floats
    far: Floats
    near: Floats
    far_far: Floats
    far_near: Floats
    near_near: Floats


def compute_softened_power(curve: AccessoryCurve, ambient_c: Floats) -> Floats:
    """Return the mean accessory power about temperatures."""
    heat, cool = _compute_shares(curve, ambient_c)
    heating, cooling = curve.heating - curve.standby, curve.cooling - curve.standby
    return np.asarray(curve.standby + heating * heat.value + cooling * cool.value)


def differentiate_softened_power(curve: AccessoryCurve, ambient_c: Floats) -> SoftenedPower:
    """Return the mean accessory power about temperatures, and its derivatives by the numbers of the curve."""
    heat, cool = _compute_shares(curve, ambient_c)
    heating, cooling = curve.heating - curve.standby, curve.cooling - curve.standby
    heat_by = np.column_stack([heat.near, heat.far])
    cool_by = -np.column_stack([cool.far, cool.near])
    levels = (1.0 - heat.value - cool.value, heat.value, cool.value)
    second = np.zeros((len(ambient_c), 7, 7))
    second[:, 3, 3], second[:, 3, 4], second[:, 4, 4] = heating * np.array(
        [heat.near_near, heat.far_near, heat.far_far]
    )
    second[:, 5, 5], second[:, 5, 6], second[:, 6, 6] = cooling * np.array(
        [cool.far_far, cool.far_near, cool.near_near]
    )
    second[:, 0, 3:] = -np.column_stack([heat_by, cool_by])
    second[:, 1, 3:5], second[:, 2, 5:] = heat_by, cool_by
    upper = np.triu(second, 1)
    return SoftenedPower(
        curve.standby + heating * heat.value + cooling * cool.value,
        np.column_stack([*levels, heating * heat_by, cooling * cool_by]),
        second + np.swapaxes(upper, 1, 2),
    )


def _compute_shares(curve: AccessoryCurve, ambient_c: Floats) -> tuple[_Share, _Share]:
    """Return the shares of heating and cooling; cooling counts temperature downwards from its choke points."""
    ambient = ambient_c + ZERO_CELSIUS
    heat = _compute_share(curve.heating_off - ambient, curve.heating_full - ambient)
    return heat, _compute_share(ambient - curve.cooling_on, ambient - curve.cooling_full)


def _compute_share(far: Floats, near: Floats) -> _Share:
    """Return a share, given the distances of temperatures from both choke points. [K]"""
    width = far - near
    ramp, slope, bend = _compute_ramp(far)
    other, other_slope, other_bend = _compute_ramp(near)
    value = (ramp - other) / width
    by_far, by_near = (slope - value) / width, (value - other_slope) / width
    return _Share(
        value, by_far, by_near,
        (bend - 2.0 * by_far) / width, (by_far - by_near) / width, (2.0 * by_near - other_bend) / width,
    )  # fmt: skip


def _compute_ramp(x: Floats) -> tuple[Floats, Floats, Floats]:
    """Return the mean of max(x, 0) over a range of x, and its first and second derivative."""
    inside = np.clip((x + SOFTENED) / (2.0 * SOFTENED), 0.0, 1.0)
    bend = np.where(np.abs(x) < SOFTENED, 0.5 / SOFTENED, 0.0)
    return np.where(x > SOFTENED, x, SOFTENED * inside * inside), inside, bend
