"""Project columns of energy off what a model could explain if it were refitted.

An effect gets no credit for what the terms of the model can explain. Measured energies and candidates are therefore
projected off these terms (Frisch-Waugh-Lovell). Each car has its own coefficients, because cars of one model differ. A
model with accessories by temperature may also use any smooth function of the temperature, multiplied by time.

What sampling distorts (`socast.core.fit.row_noise`) is projected off in the same way, and the number of stops,
because an effect that acts at stops or in acceleration would otherwise be credited with what speed between two samples
hides.

The residuals of the windows of one ride may be correlated: positively where a whole ride has high or low energy, and
negatively where windows compensate for each other. This correlation is estimated, and the means of rides are weighted
accordingly.

References
----------
Frisch and Waugh, Econometrica 1 (1933) 387, DOI 10.2307/1907330. Lovell, Journal of the American Statistical
Association 58 (1963) 993, DOI 10.1080/01621459.1963.10480682. On components of error and how to transform them away:
Swamy and Arora, Econometrica 40 (1972) 261, DOI 10.2307/1909405.
"""

from copy import copy
from typing import Final

import numpy as np
from numpy.typing import NDArray

from socast.core.batch import Floats
from socast.core.diagnose.dataset import Windows
from socast.core.fit.block_sums import build_design
from socast.core.fit.ride_blocks import get_names, get_numbers
from socast.core.fit.row_noise import (
    build_variance_parts,
    compute_robust_weights,
    estimate_variance,
    gather_distortions,
)
from socast.core.models import ANY, LinearModel, Term
from socast.core.models.features import ACCESSORIES_COLUMN, EFFECT_PREFIX, Columns

Rows = NDArray[np.int64]

KNOT_STEP: Final = 6.0
"""Distance between the knots of a smooth function of temperature. [K]"""
RANK: Final = 1e-6
"""Ratio to the largest singular value below which a singular value counts as zero."""
WINDOWS_PER_COLUMN: Final = 5
"""Least windows of a car per column of its own; a car with fewer has only its own scale and standby power."""
REWEIGHTINGS: Final = 2
"""Number of times that weights are recomputed beside selected effects, whose windows seem to be outliers before."""
ROUNDS: Final = 3
"""Number of times that weights are recomputed from the residual."""
MAX_CORRELATION: Final = 0.95
"""Largest correlation of the windows of a ride."""
LEAST_MEAN_VARIANCE: Final = 0.3
"""Least variance of the mean of a ride over that of independent windows, where windows compensate for each other."""


class BaseProjection:
    """Project columns off the terms of a model, under estimated weights.

    Parameters
    ----------
    model : LinearModel
        The model whose terms may be refitted.
    taken : (n,) float, optional
        Energy of missing effects as far as it is known, so that it does not make a window an outlier. [kWh]

    Attributes
    ----------
    weight : (n,) float
        Inverse of the variance of each window, less for outliers. [1/kWh^2]
    ride_correlation : float
        Correlation of the residuals of two windows of a ride. [1]
    residual : (n,) float
        Weighted residual after refitting. [1]
    """

    def __init__(self, windows: Windows, model: LinearModel, taken: Floats | None = None) -> None:
        self.windows = windows
        self._taken = np.zeros(len(windows.measured)) if taken is None else taken
        self.cars = [np.flatnonzero(windows.vehicle == v) for v in range(int(windows.vehicle.max()) + 1)]
        self.kinds = _kinds(windows)
        curved = any(ACCESSORIES_COLUMN in term.columns for term in model.terms)
        physical = tuple(term for term in model.terms if _physical(term))
        others = tuple(term for term in model.terms if not _physical(term))
        self._variance_parts = build_variance_parts(windows.table)
        self._windows_of_ride = np.bincount(windows.ride).astype(np.float64)
        self._per_car = np.column_stack([_terms(windows, model, physical, self.kinds), _car(windows, curved)])
        self._few = np.column_stack([windows.predicted, get_numbers(windows.table, "duration_s") / 3600.0])
        self._shared = _terms(windows, model, others, self.kinds)
        self._smooth = [_smooth(windows, rows) for rows in self.kinds.values()] if curved else []
        self._weigh()

    def _weigh(self) -> None:
        """Compute the weights, the projection under them, and the residual in turn."""
        energy = self.windows.measured[:, np.newaxis]
        self.weight, self.ride_correlation = np.ones(len(energy)), 0.0
        for _ in range(ROUNDS):
            self._project()
            standardised = self._unmixed(self.project_out(energy - self._taken[:, np.newaxis])[:, 0])
            left = standardised / np.sqrt(self.weight)
            variance = estimate_variance(self._variance_parts, left)
            self.weight = compute_robust_weights(left / np.sqrt(variance)) ** 2 / variance
            self.ride_correlation = self._correlation(left * np.sqrt(self.weight))
        self._project()
        self.residual = self.project_out(energy)[:, 0]

    def reweight(self, columns: Floats) -> "BaseProjection":
        """Return the projection with weights that are computed beside effects, given as energies. [kWh per unit]"""
        base = self
        for _ in range(REWEIGHTINGS):
            size, *_ = np.linalg.lstsq(base.project_out(columns), base.residual, rcond=None)
            base = copy(self)
            base._taken = columns @ size  # noqa: SLF001
            base._weigh()  # noqa: SLF001
        return base

    def allow_for(self, columns: Floats) -> "BaseProjection":
        """Return the projection off further columns, which cars of a model share, given as energies. [kWh per unit]"""
        base = copy(self)
        base._shared = np.column_stack([self._shared, columns])  # noqa: SLF001
        base._weigh()  # noqa: SLF001
        return base

    def get_variance_parts(self) -> Floats:
        """Return the parts of the variance of each window, as `build_variance_parts` does, (n, 4). [kWh^2]"""
        return self._variance_parts

    def _correlation(self, standardised: Floats) -> float:
        """Return the correlation of the windows of a ride."""
        square = standardised**2
        pairs = self._windows_of_ride * (self._windows_of_ride - 1.0)
        together = self.windows.by_ride(standardised) ** 2 - self.windows.by_ride(square)
        correlation = float(together.sum() / max(pairs.sum(), 1.0) / max(float(np.mean(square)), 1e-300))
        return min(correlation, MAX_CORRELATION)

    def _of_mean(self, count: Floats) -> Floats:
        """Return the variance of the mean of a number of windows of a ride, over that of their differences."""
        alike = self.ride_correlation
        return np.asarray(np.maximum((1.0 + (count - 1.0) * alike) / (1.0 - alike), LEAST_MEAN_VARIANCE))

    def apply_weights(self, columns: Floats) -> Floats:
        """Return columns weighted so that errors have equal variance and are independent, (n, k)."""
        scaled = columns * np.sqrt(self.weight)[:, np.newaxis]
        return self._mixed(scaled, 1.0 / np.sqrt(self._of_mean(self._windows_of_ride)) - 1.0)

    def convert_to_energy(self, values: Floats) -> Floats:
        """Return weighted values as energies, (n,). [kWh]"""
        return self._unmixed(values) / np.sqrt(self.weight)

    def _unmixed(self, values: Floats) -> Floats:
        """Return weighted values without the weighting of the means of rides, (n,)."""
        more = np.sqrt(self._of_mean(self._windows_of_ride)) - 1.0
        return self._mixed(values[:, np.newaxis], more)[:, 0]

    def _mixed(self, columns: Floats, more: Floats) -> Floats:
        """Return columns with so much more of the mean of their ride, (n, k)."""
        if self.ride_correlation == 0.0:
            return columns
        starts = np.flatnonzero(np.r_[True, np.diff(self.windows.ride) != 0])
        mean = np.add.reduceat(columns, starts, axis=0) / self._windows_of_ride[:, np.newaxis]
        return columns + (mean * more[:, np.newaxis])[self.windows.ride]

    def _project(self) -> None:
        """Compute orthonormal bases of the columns of each car, and of the shared columns beside them."""
        per_car = self.apply_weights(self._per_car)
        self._bases = []
        pooled = []
        few = self.apply_weights(self._few)
        for rows in self.cars:
            if len(rows) >= WINDOWS_PER_COLUMN * per_car.shape[1]:
                self._bases.append((rows, orthonormalise(per_car[rows])))
            else:
                self._bases.append((rows, orthonormalise(few[rows])))
                pooled.append(rows)
        shared = [self._by_kind(per_car, np.concatenate(pooled))] if pooled else []
        shared += (
            [self._by_kind(self.apply_weights(self._shared), np.arange(len(per_car)))] if self._shared.shape[1] else []
        )
        shared += [
            self.apply_weights(_placed(block, rows, len(per_car)))
            for block, rows in zip(self._smooth, self.kinds.values(), strict=False)
        ]
        self._common = np.empty((len(per_car), 0))
        if shared:
            self._common = orthonormalise(self._off_cars(np.column_stack(shared)))

    def _by_kind(self, columns: Floats, rows: Rows) -> Floats:
        """Return columns split by vehicle model, zero outside of `rows`."""
        inside = np.zeros(len(columns), np.bool_)
        inside[rows] = True
        blocks = [_placed(columns[r], r, len(columns)) for kind in self.kinds.values() if len(r := kind[inside[kind]])]
        return np.column_stack(blocks)

    def _off_cars(self, columns: Floats) -> Floats:
        """Return weighted columns off the columns of each car."""
        left = columns.copy()
        for rows, basis in self._bases:
            left[rows] -= basis @ (basis.T @ left[rows])
        return left

    def project_out(self, columns: Floats) -> Floats:
        """Return the part of energy columns that the model cannot explain, weighted."""
        left = self._off_cars(self.apply_weights(columns))
        return np.asarray(left - self._common @ (self._common.T @ left))

    def get_unweighted_columns(self) -> Floats:
        """Return the columns of the model split by vehicle model, not weighted and not split by car, (n, k). [kWh]"""
        every = np.arange(len(self._per_car))
        blocks = [self._by_kind(self._per_car, every)]
        blocks += [self._by_kind(self._shared, every)] if self._shared.shape[1] else []
        blocks += [
            _placed(block, rows, len(self._per_car))
            for block, rows in zip(self._smooth, self.kinds.values(), strict=False)
        ]
        return np.column_stack(blocks)

    def list_columns(self) -> tuple[list[tuple[Rows, Floats]], Floats]:
        """Return the columns of each car at its windows, and those that cars share, (n, k), not weighted. [kWh]

        Among the latter is time by a smooth function of temperature, also where the model has no accessory curve.
        """
        own, pooled = [], []
        for rows in self.cars:
            many = len(rows) >= WINDOWS_PER_COLUMN * self._per_car.shape[1]
            own.append((rows, (self._per_car if many else self._few)[rows]))
            pooled += [] if many else [rows]
        n = len(self._per_car)
        shared = [self._by_kind(self._per_car, np.concatenate(pooled))] if pooled else []
        shared += [self._by_kind(self._shared, np.arange(n))] if self._shared.shape[1] else []
        shared += [_placed(_smooth(self.windows, rows), rows, n) for rows in self.kinds.values()]
        return own, np.column_stack(shared)

    @property
    def rank(self) -> int:
        """Number of coefficients that the projection stands for."""
        return sum(basis.shape[1] for _, basis in self._bases) + self._common.shape[1]


def orthonormalise(columns: Floats) -> Floats:
    """Return an orthonormal basis of the span of columns, (n, rank); empty where all columns are zero."""
    size = np.sqrt((columns**2).sum(axis=0))
    scaled = columns[:, size > 0.0] / size[size > 0.0]
    if not scaled.shape[1]:
        return np.empty((len(columns), 0))
    left, values, _ = np.linalg.svd(scaled, full_matrices=False)
    return np.asarray(left[:, values > RANK * values[0]])


def _kinds(windows: Windows) -> dict[str, Rows]:
    """Return the rows of each vehicle model."""
    name = np.array(get_names(windows.table, "vehicle_model"), dtype=object)
    return {kind: np.flatnonzero(name == kind) for kind in sorted(set(name))}


def _physical(term: Term) -> bool:
    """Return whether a term is a physical one, whose coefficient differs between cars."""
    return bool(term.columns) and term.columns[0].startswith((EFFECT_PREFIX, ACCESSORIES_COLUMN))


def _terms(windows: Windows, model: LinearModel, terms: tuple[Term, ...], kinds: dict[str, Rows]) -> Floats:
    """Return the terms as the fit of each vehicle model evaluates them, unknown values as zero. [kWh per unit]"""
    out = np.zeros((len(windows.measured), len(terms)))
    for kind, rows in kinds.items():
        fit = model.fits.get(kind) or model.fits[ANY]
        columns = Columns(windows.table, fit.fills, fit.curve, rows)
        out[rows] = build_design(terms, columns, len(rows))
    return np.nan_to_num(out, nan=0.0)


def _car(windows: Windows, curved: bool) -> Floats:
    """Return further columns in which cars differ: standby, climbing up, stops, distortions, heating, and cooling."""
    hours = get_numbers(windows.table, "duration_s") / 3600.0
    climb = np.nan_to_num(get_numbers(windows.table, "effect_climbing_up"), nan=0.0)
    stops = np.nan_to_num(get_numbers(windows.table, "stops")) if "stops" in windows.table else np.zeros(len(hours))
    always = [hours, climb, stops, *gather_distortions(windows.table).T]
    if not curved:
        return np.column_stack(always)
    ambient = np.nan_to_num(get_numbers(windows.table, "ambient_c"), nan=15.0)
    cold, hot = np.maximum(18.0 - ambient, 0.0), np.maximum(ambient - 21.0, 0.0)
    return np.column_stack([*always, hours * cold, hours * hot])


def _smooth(windows: Windows, rows: Rows) -> Floats:
    """Return time times a linear spline of the temperature with knots every `KNOT_STEP`, (rows, knots). [h]"""
    hours = get_numbers(windows.table, "duration_s")[rows] / 3600.0
    ambient = np.nan_to_num(get_numbers(windows.table, "ambient_c")[rows], nan=15.0)
    low, high = float(ambient.min()), float(ambient.max())
    knots = np.linspace(low, high, max(2, round((high - low) / KNOT_STEP) + 1)) if high > low else np.array([low])
    step = knots[1] - knots[0] if len(knots) > 1 else 1.0
    tents = np.maximum(1.0 - np.abs(ambient[:, np.newaxis] - knots) / step, 0.0)
    return np.asarray(tents * hours[:, np.newaxis])


def _placed(block: Floats, rows: Rows, size: int) -> Floats:
    """Return a block of columns at its rows, zero elsewhere, (size, columns)."""
    out = np.zeros((size, block.shape[1]))
    out[rows] = block
    return out
