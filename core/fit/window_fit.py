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
"""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from hashlib import sha256
from typing import Final

import numpy as np
import pandas as pd
from msgspec import UNSET

from socast.core.batch import Ints
from socast.core.columns import ZERO_CELSIUS
from socast.core.errors import ModelError
from socast.core.fit.block_sums import build_design, limit_to_one_thread
from socast.core.fit.distortions import DISTORTED_COLUMNS, DISTORTIONS, gather_distortions
from socast.core.fit.measured_rows import ENERGY_SD
from socast.core.fit.nested_effects import Gaussian
from socast.core.fit.priors import (
    CHOKE_POINTS,
    LEVELS,
    build_curve_prior,
    build_prior,
    compute_curve_columns,
    find_curve_limits,
    find_limits,
    flatten_curve,
    is_curved,
)
from socast.core.fit.ride_blocks import (
    ENERGY,
    assign_vehicle_days,
    get_names,
    get_numbers,
    select_trainable,
    word_too_few_rides,
)
from socast.core.fit.row_noise import build_variance_parts
from socast.core.fit.window_problem import GroupRows
from socast.core.fit.window_solver import GroupFit, solve_group
from socast.core.models import ANY, VEHICLE, VEHICLE_MODEL, Fit, LinearModel, Term, Training, stamp
from socast.core.models.derived_features import DERIVED_COLUMNS
from socast.core.models.features import ACCESSORIES_COLUMN, FEATURES, Columns, list_raw_columns
from socast.core.models.limit import LIMIT_NEEDS, EnergyLimit, sum_training
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
    kinds = np.array(get_names(good, VEHICLE_MODEL), dtype=object)
    keys = good["ride_key"].to_numpy(dtype=object)
    if (count := len(set(keys.tolist()))) < LEAST_RIDES:
        every = rows.drop_duplicates("ride_key") if ride_table is None else ride_table
        reasons = select_trainable(every, [column for column in read if column in every])[1]
        raise ModelError(word_too_few_rides(name, count, LEAST_RIDES, reasons))
    fills = {key: _find_fills(terms, good.iloc[at]) for key, at in _split_groups(kinds)}
    rides = {key: len(set(keys[at].tolist())) for key, at in _split_groups(kinds)}
    alone = len(rides) == 2 and rides[ANY] == min(rides.values())
    groups: dict[str, GroupFit] = {}
    fits = {}
    with limit_to_one_thread():
        for key, at in _split_groups(kinds):
            if key == ANY if alone else (key != ANY and rides[key] < LEAST_OWN_RIDES):
                continue
            group = gather_rows(terms, good.iloc[at], fills[key], distortions)
            groups[key] = solve_group(group)
            fits[key] = _convert(terms, group, groups[key], fills[key], _find_limit(group, good.iloc[at]))
    if alone:
        only = next(iter(groups))
        groups, fits = groups | {ANY: groups[only]}, fits | {ANY: fits[only]}
    return _assemble(name, terms, good, read, fits), groups


def _split_groups(kinds: np.ndarray[tuple[int], np.dtype[np.object_]]) -> Iterator[tuple[str, Ints]]:
    """Yield each vehicle model with its rows, then all rows together."""
    for kind in sorted(set(kinds.tolist()) - {"", ANY}):
        yield kind, np.flatnonzero(kinds == kind)
    yield ANY, np.arange(len(kinds))


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
    prior, limits = build_prior(plain, columns, n), np.array(find_limits(plain, columns))
    spread = np.array(list(distortions.values()))
    prior = _join(prior, Gaussian(np.zeros(len(spread)), np.diag(spread**2)))
    limits = np.column_stack([limits, np.tile([[-np.inf], [np.inf]], len(spread))])
    if curved:
        prior = _join(prior, build_curve_prior())
        limits = np.column_stack([limits, np.array(find_curve_limits())])
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
        prior=prior,
        low=limits[0],
        high=limits[1],
        curved=curved,
    )


def _join(one: Gaussian, other: Gaussian) -> Gaussian:
    """Return the distribution of two independent sets of coefficients."""
    size = len(one.mean)
    covariance = np.zeros((size + len(other.mean),) * 2)
    covariance[:size, :size], covariance[size:, size:] = one.covariance, other.covariance
    return Gaussian(np.concatenate([one.mean, other.mean]), covariance)


def _find_limit(group: GroupRows, rows: pd.DataFrame) -> EnergyLimit | None:
    """Return the limit that follows from the whole rides, as windows take and return more than a ride."""
    rides = [np.bincount(group.ride, get_numbers(rows, name)).astype(np.float64) for name in (ENERGY, *LIMIT_NEEDS)]
    return EnergyLimit.of_training(*sum_training(*rides).tolist())


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
