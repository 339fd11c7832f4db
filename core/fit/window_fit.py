"""Fit the physical terms of a model to windows, with what physics tells of each coefficient as the prior.

Each row is a window of a metered ride, or a whole ride where only the state of charge measures its energy
(`socast.core.fit.measured_rows`). Its weight is the inverse of its variance: the noise of its measurement and what the
terms cannot know, estimated from the residuals (`socast.core.fit.row_noise`). Errors of the windows of a ride, of the
rides of a vehicle-day and of the vehicle-days of a car depend on each other (`socast.core.fit.nested_effects`).

The coefficients of a vehicle model have the Gaussian prior of `socast.core.fit.priors`. Few rides therefore move them
little, and many rides determine them. The cars of a vehicle model share its coefficients; how much cars differ by a
factor is estimated and is part of their uncertainty. The model does not hold the factors, which would hide a missing
effect.

The accessory curve has a prior too, see `socast.core.fit.window_solver`.

The prediction interval is calibrated on rides that each fit did not see. The sums of products of single vehicle-days
and cars give the coefficients of every fit without a vehicle-day or without a vehicle model, at the cost of one small
system of equations each. The errors of a ride under the fit without its vehicle-day calibrate the interval; those under
the fit without its vehicle model that of unseen vehicle models. Weights, spreads and the linearised curve stay those of
all rides, so these errors are slightly too small.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from hashlib import sha256
from typing import Final

import numpy as np
import pandas as pd
from msgspec import UNSET
from msgspec.structs import replace
from scipy.linalg import block_diag

from socast.core.batch import Floats
from socast.core.columns import ZERO_CELSIUS
from socast.core.errors import ModelError
from socast.core.fit.accessory_curve import CHOKE_POINTS, LEVELS, compute_curve_columns, flatten_curve
from socast.core.fit.block_sums import build_design, limit_to_one_thread
from socast.core.fit.calibration import NEEDS, calibrate_interval, expect_interval, group_errors
from socast.core.fit.measured_rows import ENERGY_SD
from socast.core.fit.nested_effects import Gaussian, compute_coefficients, integrate_car_factor
from socast.core.fit.priors import build_curve_prior, build_prior, find_curve_limits, find_limits, is_curved
from socast.core.fit.records import FitStep
from socast.core.fit.ride_blocks import (
    ENERGY,
    assign_vehicle_days,
    get_names,
    get_numbers,
    group_by_name,
    select_trainable,
    word_too_few_rides,
)
from socast.core.fit.row_noise import DISTORTED_COLUMNS, DISTORTIONS, build_variance_parts, gather_distortions
from socast.core.fit.window_solver import GroupFit, GroupRows, solve_group
from socast.core.models import ANY, VEHICLE, VEHICLE_MODEL, Fit, LinearModel, Term, Training, stamp
from socast.core.models.features import ACCESSORIES_COLUMN, DERIVED_COLUMNS, FEATURES, Columns, list_raw_columns
from socast.core.models.limit import LIMIT_NEEDS, EnergyLimit, sum_training
from socast.core.vehicles import AccessoryCurve
from socast.core.vehicles.fleet import CarParameters

LEAST_RIDES: Final = 1
"""Fewest rides for a fit."""
LEAST_OWN_RIDES: Final = 3
"""Fewest rides for a fit of a vehicle model of its own, where there are others."""
PRIOR_SHARE: Final = 0.8
"""Posterior over prior variance above which a coefficient counts as fixed by its prior. [1]"""
NEAR_LIMIT: Final = 1e-6
"""Distance from a limit below which a coefficient is at it, over the standard deviation of its prior. [1]"""
READ: Final = (
    "effect_rolling",
    "rolling_resistance",
    "effect_inertia_positive",
    *LIMIT_NEEDS,
    "energy_vi_kwh",
    "energy_vi_sd_kwh",
    "energy_soc_sd_kwh",
    "unresolved_braking_kwh",
)
"""Columns that the weights and the distortions need, besides those of the terms."""


def fit_rows(
    name: str,
    terms: tuple[Term, ...],
    rows: pd.DataFrame,
    ride_table: pd.DataFrame | None = None,
    distortions: Mapping[str, float] = DISTORTIONS,
) -> tuple[LinearModel, dict[str, GroupFit]]:
    """Return a model fitted to measured rows, without an interval, and the fit of each vehicle model.

    Parameters
    ----------
    ride_table : DataFrame, optional
        Rides of the same recordings, to say why rides are left out where too few are left.
    distortions : mapping of str to float
        Standard deviations of the distortions of sampling, in the order of `DISTORTIONS`.

    Returns
    -------
    model : LinearModel
        Model with a fit for each vehicle model of at least `LEAST_OWN_RIDES` rides, or for the only one, and the fit
        `*` of all rides.
    """
    _check(name, terms, rows)
    read = _list_columns(terms)
    good, _ = select_trainable(rows, read)
    good = good.assign(**{VEHICLE: get_names(good, VEHICLE), "date": get_names(good, "date")})
    good = good.sort_values([VEHICLE, "date", "ride_key"], kind="stable", ignore_index=True)
    keys = good["ride_key"].to_numpy(dtype=object)
    if (count := len(set(keys))) < LEAST_RIDES:
        every = rows.drop_duplicates("ride_key") if ride_table is None else ride_table
        reasons = select_trainable(every, [column for column in read if column in every])[1]
        raise ModelError(word_too_few_rides(name, count, LEAST_RIDES, reasons))
    kinds = group_by_name(get_names(good, VEHICLE_MODEL))
    parts = {key: at for key, at in kinds.items() if key not in {"", ANY}}
    alone = next((key for key, at in parts.items() if len(at) == len(good)), None)
    if alone is None:
        parts = {key: at for key, at in parts.items() if len(set(keys[at])) >= LEAST_OWN_RIDES}
        parts[ANY] = np.arange(len(good))
    groups, fits = {}, {}
    with limit_to_one_thread():
        for key, at in parts.items():
            rows, fills = good.iloc[at], _find_fills(terms, good.iloc[at])
            group = gather_rows(terms, rows, fills, distortions)
            groups[key] = solve_group(group)
            # windows take and return more than their ride, so the limit follows from whole rides
            columns = [get_numbers(rows, name) for name in (ENERGY, *LIMIT_NEEDS)]
            rides = [np.bincount(group.ride, column).astype(np.float64) for column in columns]
            limit = EnergyLimit.of_training(*sum_training(*rides).tolist())
            fits[key] = _convert(terms, group, groups[key], fills, limit)
    if alone is not None:  # the fit of the only vehicle model is that of all rides
        groups[ANY], fits[ANY] = groups[alone], fits[alone]
    return _assemble(name, terms, good, read, fits), groups


def _list_columns(terms: Sequence[Term]) -> list[str]:
    """Return the columns of the tables that a fit reads."""
    read = [column for term in terms for column in term.columns]
    raw = [name for column in read for name in list_raw_columns(column)]
    return list(dict.fromkeys((*raw, *READ, ENERGY)))


def _check(name: str, terms: Sequence[Term], rows: pd.DataFrame) -> None:
    """Refuse rows without a needed column, and terms that do not add up over a ride."""
    for column in (*_list_columns(terms), "ride_key", VEHICLE):
        if column not in rows:
            raise ModelError(f"recipe {name}: column {column!r} is missing: make the tables again with `socast tables`")
    for term in terms:
        if not term.columns or (ACCESSORIES_COLUMN in term.columns and not is_curved(term)):
            raise ModelError(f"recipe {name}: term {term.name!r} does not add up over windows: fit it to rides")


def _find_fills(terms: Sequence[Term], rows: pd.DataFrame) -> dict[str, float]:
    """Return the means that replace unknown values of columns other than energies and figures of the car."""
    read = dict.fromkeys(column for term in terms for column in term.columns)
    if ACCESSORIES_COLUMN in read:
        read |= {"ambient_c": None}
    fills, columns = {}, Columns(rows)
    for name in read:
        if (name in FEATURES and name not in CarParameters._fields) or name in DERIVED_COLUMNS:
            known = columns[name][np.isfinite(columns[name])]
            fills[name] = float(known.mean()) if len(known) else 0.0
    return fills


def gather_rows(
    terms: Sequence[Term],
    rows: pd.DataFrame,
    fills: Mapping[str, float],
    distortions: Mapping[str, float] = DISTORTIONS,
) -> GroupRows:
    """Return the columns of rows that a fit needs."""
    columns, n = Columns(rows, fills), len(rows)
    curved = any(is_curved(term) for term in terms)
    plain = tuple(term for term in terms if not is_curved(term))
    energy, hours = get_numbers(rows, ENERGY), columns["duration_s"] / 3600.0
    time = [hours * columns["accessory_scale"] / 1e3] if curved else []
    rolling = columns["effect_rolling"] * columns["rolling_resistance"]
    spread = np.array(list(distortions.values()))
    unlimited = np.full(len(spread), np.inf)
    priors = [build_prior(plain, columns, n), Gaussian(np.zeros(len(spread)), np.diag(spread**2))]
    limits = [find_limits(plain, columns), (-unlimited, unlimited)]
    if curved:
        priors.append(build_curve_prior())
        limits.append(find_curve_limits())
    low, high = (np.concatenate(ends) for ends in zip(*limits, strict=True))
    means, covariances = zip(*priors, strict=True)
    ride, keys = pd.factorize(rows["ride_key"])
    first = np.unique(ride, return_index=True)[1]
    names = rows[VEHICLE].to_numpy(dtype=object)[first]
    day = assign_vehicle_days(rows.iloc[first])
    car, cars = pd.factorize(names[np.unique(day, return_index=True)[1]])
    return GroupRows(
        columns=np.column_stack(
            [build_design(plain, columns, n), gather_distortions(rows), *time, energy, rolling, hours]
        ),
        ambient_c=columns["ambient_c"] if curved else np.zeros(n),
        ride=ride.astype(np.int64),
        day=day,
        car=car.astype(np.int64),
        rides=tuple(keys),
        cars=tuple(cars),
        parts=build_variance_parts(rows),
        prior=Gaussian(np.concatenate(means), block_diag(*covariances)),
        low=low,
        high=high,
        curved=curved,
    )


def _convert(
    terms: Sequence[Term], group: GroupRows, fitted: GroupFit, fills: Mapping[str, float], limit: EnergyLimit | None
) -> Fit:
    """Return the fit of a group as a model file stores it."""
    p = group.terms
    change = np.zeros((len(terms), len(fitted.posterior.mean)))
    values = np.ones(len(terms))
    plain = [i for i, term in enumerate(terms) if not is_curved(term)]
    change[plain, range(len(plain))] = 1.0
    values[plain] = fitted.posterior.mean[: len(plain)]
    if fitted.curve is not None:  # the coefficient of the accessories is their energy over that of the curve
        time = group.columns[:, p]
        used = float(time @ fitted.curve.power(group.ambient_c + ZERO_CELSIUS))
        slopes = time @ compute_curve_columns(fitted.curve, group.ambient_c)
        change[[i for i in range(len(terms)) if i not in plain], p:] = slopes / used if used > 0.0 else 0.0
    covariance = change @ fitted.posterior.covariance @ change.T
    before = change @ group.prior.covariance @ change.T
    share = np.diag(covariance) / np.maximum(np.diag(before), 1e-300)
    return Fit(
        coefficients=tuple(values.tolist()),
        covariance=tuple(tuple(row) for row in covariance.tolist()),
        clusters=len(group.car),
        fills=dict(fills),
        curve=fitted.curve,
        rides=len(group.rides),
        held=tuple(term.name for term, own in zip(terms, share, strict=True) if own > PRIOR_SHARE),
        limited=_find_limited([terms[i].name for i in plain], group, fitted),
        converged=fitted.converged,
        limit=limit or UNSET,
    )


def _find_limited(names: Sequence[str], group: GroupRows, fitted: GroupFit) -> tuple[str, ...]:
    """Return the terms and the numbers of the curve that are at a limit."""
    values, names = fitted.posterior.mean[: group.terms], [*names, *DISTORTIONS]
    if fitted.curve is not None:
        values, names = np.concatenate([values, flatten_curve(fitted.curve)]), [*names, *LEVELS, *CHOKE_POINTS]
    near = NEAR_LIMIT * np.sqrt(np.diag(group.prior.covariance))
    at = (values - group.low < near) | (group.high - values < near)
    return tuple(name for name, own in zip(names, at, strict=True) if own)


def _assemble(
    name: str,
    terms: tuple[Term, ...],
    rows: pd.DataFrame,
    read: Sequence[str],
    fits: Mapping[str, Fit],
) -> LinearModel:
    """Return the model with its fits and the description of the training."""
    once = rows.drop_duplicates("ride_key")
    counts = Counter(kind for kind in get_names(once, VEHICLE_MODEL) if kind)
    dates = [date for date in once["date"] if date]
    digest = sha256()
    for column in sorted({*read, ENERGY_SD, *DISTORTED_COLUMNS} & set(rows.columns)):
        if column != VEHICLE:
            digest.update(column.encode() + np.ascontiguousarray(get_numbers(rows, column)).tobytes())
    for column in (VEHICLE, VEHICLE_MODEL, "ride_key"):
        digest.update("\n".join([column, *get_names(rows, column)]).encode())
    training = Training(
        rides=len(once),
        first_date=min(dates, default=""),
        last_date=max(dates, default=""),
        vehicle_models=dict(sorted(counts.items())),
        fingerprint=digest.hexdigest(),
    )
    return stamp(
        LinearModel(
            name=name, version="", recipe=name, terms=terms, fits=dict(sorted(fits.items())),
            training=training,
        )
    )  # fmt: skip


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
    own, every = np.full(len(good), np.nan), np.full(len(good), np.nan)
    for kind, rows in group_by_name(get_names(good, VEHICLE_MODEL)).items():
        own[rows] = _HeldOut(model, groups, kind if kind in groups else ANY, good.iloc[rows]).without_day()
        if len(rows) < len(good):
            every[rows] = _HeldOut(model, groups, ANY, good.iloc[rows]).without_cars()
    seen, unseen = (
        {key: errors for key, errors in group_errors(good, error).items() if len(errors.error)}
        for error in (own, every)
    )
    interval = (calibrate_interval(seen, unseen) or expect_interval(seen)) if seen else None
    return stamp(replace(model, interval=interval))


class _HeldOut:
    """Compute the errors of rides of one vehicle model under a fit without parts of its rides. [kWh]"""

    def __init__(self, model: LinearModel, groups: dict[str, GroupFit], key: str, rides: pd.DataFrame) -> None:
        self.fitted = groups[key]
        columns = Columns(rides, model.fits[key].fills, self.fitted.curve)
        self.columns, self.offset = build_prediction_columns(model.terms, columns, len(rides), self.fitted.curve)
        self.energy = get_numbers(rides, ENERGY)
        place = pd.Index(self.fitted.rides).get_indexer(pd.Index(rides["ride_key"]))
        self.day = np.where(place >= 0, self.fitted.products.day[place], -1)  # -1 where the fit has no row of a ride
        self.cars = integrate_car_factor(self.fitted.elimination.cars, self.fitted.spreads.car).sums

    def without_day(self) -> Floats:
        """Return the error of each ride under the fit without its vehicle-day; NaN for a ride outside of the fit."""
        fitted, car = self.fitted, self.fitted.products.car
        rest = fitted.elimination.cars[car] - fitted.elimination.days
        changed = integrate_car_factor(rest, fitted.spreads.car).sums
        mean = compute_coefficients(fitted.prior, self.cars.sum(axis=0) - self.cars[car] + changed).mean
        predicted = np.einsum("ij,ij->i", self.columns, mean[self.day]) + self.offset
        return np.where(self.day >= 0, self.energy - predicted, np.nan)

    def without_cars(self) -> Floats:
        """Return the error of each ride under the fit without the cars of all of these rides."""
        kept = np.ones(len(self.cars), np.bool_)
        kept[self.fitted.products.car[self.day[self.day >= 0]]] = False
        mean = compute_coefficients(self.fitted.prior, self.cars[kept].sum(axis=0)).mean
        return self.energy - self.columns @ mean - self.offset


def build_prediction_columns(
    terms: Sequence[Term], columns: Columns, rows: int, curve: AccessoryCurve | None
) -> tuple[Floats, Floats]:
    """Return the columns of the coefficients of a fit and of the numbers of its curve, and the energy by the curve.

    Predictions contain no distortions of the measurement, so that their columns are zero.
    """
    plain = tuple(term for term in terms if not is_curved(term))
    table = np.column_stack([build_design(plain, columns, rows), np.zeros((rows, len(DISTORTIONS)))])
    if curve is None:
        return table, np.zeros(rows)
    time = columns["duration_s"] * columns["accessory_scale"] / 3.6e6
    slopes = compute_curve_columns(curve, columns["ambient_c"]) * time[:, np.newaxis]
    return np.column_stack([table, slopes]), time * curve.power(columns["ambient_c"] + ZERO_CELSIUS)


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
        fits[key] = replace(fit, residual_sd_kwh=sd)
    training = model.training and replace(model.training, left_out=dict(sorted(left_out.items())))
    step = FitStep(action="fit", recipe=model.recipe, mae_in_sample_kwh=errors)
    return replace(model, fits=fits, training=training, history=(step.to_json(),))
