"""Calibrate the prediction interval of a model that was fitted to windows, on rides that each fit did not see.

The sums of products of single vehicle-days and cars give the coefficients of every fit without a vehicle-day or without
a vehicle model, at the cost of one small system of equations each. The errors of a ride under the fit without its
vehicle-day calibrate the interval; those under the fit without its vehicle model that of unseen vehicle models.
Weights, spreads and the linearised curve stay those of all rides, so these errors are slightly too small.
"""

import msgspec
import numpy as np
import pandas as pd

from socast.core.batch import Floats, Ints
from socast.core.columns import ZERO_CELSIUS
from socast.core.fit.block_sums import build_design
from socast.core.fit.calibration import NEEDS, HeldOutErrors, calibrate_interval, expect_interval, group_errors
from socast.core.fit.distortions import DISTORTIONS
from socast.core.fit.nested_effects import compute_coefficients, integrate_car_factor
from socast.core.fit.priors import compute_curve_columns, is_curved
from socast.core.fit.records import FitStep
from socast.core.fit.ride_blocks import ENERGY, get_names, get_numbers, select_trainable
from socast.core.fit.window_solver import GroupFit
from socast.core.models import ANY, VEHICLE_MODEL, LinearModel, stamp
from socast.core.models.features import Columns


def add_window_interval(model: LinearModel, groups: dict[str, GroupFit], rides: pd.DataFrame) -> LinearModel:
    """Return a model with an interval and with the in-sample errors of its rides.

    Returns
    -------
    LinearModel
        Without an interval where the rides lack a column that the scale of errors needs. Where they are too few to
        calibrate one, it has that of `expect_interval`.
    """
    good, left_out = select_trainable(rides, [*model.needs, ENERGY])
    model = _describe(model, good, dict(left_out))
    if any(column not in rides for column in NEEDS):
        return stamp(model)
    kinds = np.array(get_names(good, VEHICLE_MODEL), dtype=object)
    own, every = np.full(len(good), np.nan), np.full(len(good), np.nan)
    for kind in set(kinds.tolist()):
        rows = np.flatnonzero(kinds == kind)
        own[rows] = _HeldOut(model, groups, kind if kind in groups else ANY, good.iloc[rows]).without_day()
        if len(rows) < len(good):
            every[rows] = _leave_out_rows(model, groups, good, rows)
    seen, unseen = (_list_known(group_errors(good, error)) for error in (own, every))
    interval = calibrate_interval(seen, unseen) if seen else None
    if interval is None and seen:
        interval = expect_interval(seen)
    return stamp(msgspec.structs.replace(model, interval=interval))


def _list_known(errors: dict[str, HeldOutErrors]) -> dict[str, HeldOutErrors]:
    """Return the vehicle models that have errors."""
    return {key: own for key, own in errors.items() if len(own.error)}


class _HeldOut:
    """Compute the errors of rides of one vehicle model under fits without parts of its rides."""

    def __init__(self, model: LinearModel, groups: dict[str, GroupFit], key: str, rides: pd.DataFrame) -> None:
        self.fitted = groups[key]
        self.columns, self.offset = _design(model, key, self.fitted, rides)
        self.energy = get_numbers(rides, ENERGY)
        self.day, _ = _find_places(self.fitted, rides)
        spread, sums = self.fitted.spreads.car, self.fitted.elimination.cars
        self.cars = integrate_car_factor(sums, spread).sums
        self.total = self.cars.sum(axis=0)

    def without_day(self) -> Floats:
        """Return the error of each ride under the fit without its vehicle-day, (n,). [kWh]"""
        fitted, car = self.fitted, self.fitted.products.car
        rest = fitted.elimination.cars[car] - fitted.elimination.days
        changed = integrate_car_factor(rest, fitted.spreads.car).sums
        mean = compute_coefficients(fitted.prior, self.total - self.cars[car] + changed).mean
        return self._compute_errors(mean, self.day)

    def _compute_errors(self, mean: Floats, place: Ints) -> Floats:
        """Return the error of each ride, with the coefficients of its part; NaN for a ride outside of the fit."""
        predicted = np.einsum("ij,ij->i", self.columns, mean[place]) + self.offset
        return np.where(place >= 0, self.energy - predicted, np.nan)


def _leave_out_rows(model: LinearModel, groups: dict[str, GroupFit], rides: pd.DataFrame, rows: Ints) -> Floats:
    """Return the errors of the rides of one vehicle model under the fit `*` without them, (rows,). [kWh]"""
    fitted = groups[ANY]
    _, car = _find_places(fitted, rides)
    cars = integrate_car_factor(fitted.elimination.cars, fitted.spreads.car).sums
    kept = np.ones(len(cars), np.bool_)
    kept[car[rows][car[rows] >= 0]] = False
    mean = compute_coefficients(fitted.prior, cars[kept].sum(axis=0)).mean
    columns, offset = _design(model, ANY, fitted, rides.iloc[rows])
    return get_numbers(rides, ENERGY)[rows] - columns @ mean - offset


def _design(model: LinearModel, key: str, fitted: GroupFit, rides: pd.DataFrame) -> tuple[Floats, Floats]:
    """Return the columns of the coefficients of a fit for rides, and the energy by the curve. [kWh]

    Predictions contain no distortions of the measurement, so that their columns are zero.
    """
    plain = tuple(term for term in model.terms if not is_curved(term))
    columns = Columns(rides, model.fits[key].fills, fitted.curve)
    table = np.column_stack([build_design(plain, columns, len(rides)), np.zeros((len(rides), len(DISTORTIONS)))])
    if fitted.curve is None:
        return table, np.zeros(len(rides))
    time = columns["duration_s"] * columns["accessory_scale"] / 3.6e6
    slopes = compute_curve_columns(fitted.curve, columns["ambient_c"]) * time[:, np.newaxis]
    return np.column_stack([table, slopes]), time * fitted.curve.power(columns["ambient_c"] + ZERO_CELSIUS)


def _find_places(fitted: GroupFit, rides: pd.DataFrame) -> tuple[Ints, Ints]:
    """Return the vehicle-day and the car of each ride in a fit, -1 where the fit has no row of it."""
    place = pd.Index(fitted.rides).get_indexer(pd.Index(rides["ride_key"]))
    day = np.where(place >= 0, fitted.products.day[place], -1)
    return day, np.where(day >= 0, fitted.products.car[day], -1)


def _describe(model: LinearModel, rides: pd.DataFrame, left_out: dict[str, int]) -> LinearModel:
    """Return a model with the residuals of its rides and the number of rides that are left out."""
    kinds = np.array(get_names(rides, VEHICLE_MODEL), dtype=object)
    left = get_numbers(rides, ENERGY) - model.predict_energy(rides)
    fits, errors = {}, {}
    for key, fit in model.fits.items():
        own = left[((kinds == key) | (key == ANY)) & np.isfinite(left)]
        if len(own):
            errors[key] = float(np.abs(own).mean())
        sd = float(np.sqrt(np.mean(own**2))) if len(own) else None
        fits[key] = msgspec.structs.replace(fit, residual_sd_kwh=sd)
    training = model.training and msgspec.structs.replace(model.training, left_out=dict(sorted(left_out.items())))
    step = FitStep(action="fit", recipe=model.recipe, mae_in_sample_kwh=errors)
    return msgspec.structs.replace(model, fits=fits, training=training, history=(step.to_json(),))
