"""Collect the windows to diagnose: those of rides fit for training, with the prediction of a model for each.

The total of a ride hides when its error occurred. Diagnosis therefore uses windows of about one minute where voltage
and current are measured.

Where only the state of charge is measured, a window lasts until the state of charge changes. An unknown consumer then
shortens the very window in which it is sought, which biases everything that is fitted to the window. In that case the
whole ride is one row, because its ends do not depend on its energy.

All windows of a metered ride are metered. A choice of the more certain measurement window by window would select
windows by their energy.
"""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import msgspec
import numpy as np
import pandas as pd

from core.batch import Floats, Ints
from core.errors import ModelError
from core.fit.calibration import add_interval
from core.fit.fitting import fit_terms
from core.fit.measurement_noise import is_metered
from core.fit.recipes import LinearRecipe, get_recipe
from core.fit.ride_blocks import ENERGY, RideFrame, get_names, get_numbers, select_trainable
from core.models import ANY, LinearModel
from core.models.features import Columns
from core.stats.clustered import assign_vehicle_days

RIDE_COLUMNS: Final = ("ride_id", "date", "winter", "summer", "fit_for_training", "unfit_reason")
"""Columns of the ride table that each window receives."""
ENERGY_SD: Final = "energy_sd_kwh"
LEAST_RIDES: Final = 20
"""Number of rides below which a diagnosis is not possible."""
LEAST_DAYS: Final = 6
"""Number of vehicle-days below which errors cannot be shown to be independent."""


@dataclass(frozen=True)
class Windows:
    """Hold windows ordered by vehicle and time, in columns of equal length.

    Parameters
    ----------
    table : (n, columns) DataFrame
        The window table, with `RIDE_COLUMNS`.
    rides : (rides, columns) DataFrame
        The ride table of the same rides, in the order of `ride`.
    measured, predicted : (n,) float
        Energy of each window. [kWh]
    ride, vehicle, date, day : (n,) int64
        Codes of the ride, of the vehicle, of the date, and of the vehicle-day.
    left_out : mapping of str to int
        Number of rides that are not diagnosed, by reason.
    """

    table: pd.DataFrame
    rides: pd.DataFrame
    measured: Floats
    predicted: Floats
    ride: Ints
    vehicle: Ints
    date: Ints
    day: Ints
    left_out: Mapping[str, int]

    def columns(self) -> Columns:
        """Return the columns that terms and effects read."""
        return Columns(self.table)

    @property
    def day_of_ride(self) -> Ints:
        """Code of the vehicle-day of each ride, (rides,)."""
        first = np.flatnonzero(np.r_[True, np.diff(self.ride) != 0])
        return np.asarray(self.day[first], dtype=np.int64)

    def by_ride(self, values: Floats) -> Floats:
        """Return the sum of window values over each ride, (rides,)."""
        return np.asarray(np.bincount(self.ride, values, len(self.rides)), dtype=np.float64)


def join_tables(rides: pd.DataFrame, windows: pd.DataFrame) -> pd.DataFrame:
    """Return the measured rows of rides fit for training: their windows, or the whole ride where no meter measures.

    Parameters
    ----------
    rides, windows : DataFrame
        The tables of the same recordings, as `core.totals.tables` makes them.

    Returns
    -------
    DataFrame
        Rows ordered by vehicle and time, with `RIDE_COLUMNS`.

    Raises
    ------
    ModelError
        The tables are not of the same rides, or a column is missing.
    """
    for table, what in ((rides, "ride"), (windows, "window")):
        if lacking := [name for name in ("ride_key", "vehicle_id", "start_s", ENERGY) if name not in table]:
            raise ModelError(f"the {what} table has no column {lacking[0]!r}: make the tables again, `socast tables`")
    keys = pd.Index(rides["ride_key"])
    if not keys.is_unique:
        twice = keys[keys.duplicated()][0]
        raise ModelError(f"ride {twice} is in the ride table twice: give each recording's tables once")
    place = keys.get_indexer(windows["ride_key"])
    if len(rides) and not (place >= 0).any():
        raise ModelError("no window belongs to any of the rides: give the windows.parquet that was made with the rides")
    fit = rides["fit_for_training"].to_numpy(dtype=bool, na_value=False) if "fit_for_training" in rides else True
    good = fit & np.isfinite(get_numbers(rides, ENERGY))
    by_power = is_metered(rides)
    of_ride = {name: rides[name].to_numpy()[place] for name in RIDE_COLUMNS if name in rides}
    of_ride |= {ENERGY: get_numbers(windows, "energy_vi_kwh"), ENERGY_SD: get_numbers(windows, "energy_vi_sd_kwh")}
    kept = (
        (place >= 0)
        & (good & by_power)[place]
        & np.isfinite(of_ride[ENERGY])
        & (get_numbers(windows, "duration_s") > 0.0)
    )
    others = windows.drop(columns=[name for name in of_ride if name in windows])
    parts = pd.concat([others, pd.DataFrame(of_ride, index=windows.index)], axis=1).loc[kept]
    whole = rides.loc[good & ~by_power, [name for name in parts.columns if name in rides]]
    table = pd.concat([parts, whole], ignore_index=True) if len(whole) else parts
    begin = table.groupby("ride_key", sort=False)["start_s"].transform("min")  # clock steps can interleave rides
    order = np.lexsort((get_numbers(table, "start_s"), pd.factorize(table["ride_key"])[0], begin))
    return table.iloc[order].sort_values("vehicle_id", kind="stable", ignore_index=True)


def fit_to_windows(name: str, rides: pd.DataFrame, windows: pd.DataFrame, *, covariance: bool = True) -> LinearModel:
    """Return a recipe of linear terms fitted to windows instead of rides.

    Windows distinguish what the totals of rides only add up: accelerating from braking, and time from distance.

    Parameters
    ----------
    name : str
        Name of a recipe of linear terms.
    rides, windows : DataFrame
        The tables of the same recordings.
    covariance : bool
        Whether to compute the covariance of the coefficients and the interval of predictions.

    Returns
    -------
    LinearModel
        The fitted model; its counts and in-sample errors are those of rides.

    Raises
    ------
    ModelError
        The recipe is not one of linear terms, or `join_tables` or the fit raises.
    """
    chosen = get_recipe(name)
    if not isinstance(chosen, LinearRecipe):
        raise ModelError(f"recipe {name} cannot be fitted to windows: choose road_load or one of the paper's")
    table = join_tables(rides, windows)
    model = _count_rides(fit_terms(chosen, RideFrame(table), covariance=covariance), table, rides)
    return add_interval(model, rides) if covariance else model


def _count_rides(model: LinearModel, table: pd.DataFrame, rides: pd.DataFrame) -> LinearModel:
    """Return a model fitted to windows, with the number and the errors of their rides."""
    ride, _ = pd.factorize(table["ride_key"])
    kind = table.drop_duplicates("ride_key")["vehicle_model"].to_numpy(dtype=object)
    fits, errors = {}, {}
    for key, fit in model.fits.items():
        alone = msgspec.structs.replace(model, fits={ANY: fit})
        left = np.bincount(ride, get_numbers(table, ENERGY) - alone.predict(table))[(kind == key) | (key == ANY)]
        fits[key] = msgspec.structs.replace(fit, rides=len(left), residual_sd_kwh=float(np.sqrt(np.mean(left**2))))
        errors[key] = float(np.mean(np.abs(left)))
    counts = Counter(name for name in kind.tolist() if isinstance(name, str))
    _, left_out = select_trainable(rides, [ENERGY])
    training = model.training and msgspec.structs.replace(
        model.training, rides=len(kind), vehicle_models=dict(sorted(counts.items())), left_out=dict(left_out)
    )
    history = tuple(entry | {"mae_in_sample_kwh": errors} for entry in model.history)
    return msgspec.structs.replace(model, training=training, fits=fits, history=history)


def gather_windows(rides: pd.DataFrame, windows: pd.DataFrame, model: LinearModel) -> Windows:
    """Return the windows to diagnose, with the predictions of a model.

    Parameters
    ----------
    rides, windows : DataFrame
        The tables of the same recordings.
    model : LinearModel
        The model to diagnose.

    Returns
    -------
    Windows
        Windows with a measured and a predicted energy.

    Raises
    ------
    ModelError
        There are too few rides or vehicle-days, no ride has a measured energy, or the model knows none of the vehicle
        models.
    """
    _, left_out = select_trainable(rides, [ENERGY])
    table = join_tables(rides, windows)
    _check_model(model, table)
    predicted = model.predict(table) if len(table) else np.empty(0)
    known = np.isfinite(predicted)
    if not known.all():
        left_out["not predicted"] = int(table.loc[~known, "ride_key"].nunique())
        table, predicted = table.loc[known].reset_index(drop=True), predicted[known]
    ride, keys = pd.factorize(table["ride_key"])
    if unmeasured := _count_unmeasured(windows, rides, table):
        left_out["windows without voltage and current"] = unmeasured
    if len(keys) < LEAST_RIDES:
        why = ", ".join(f"{n:,} {reason.replace('_', ' ')}" for reason, n in sorted(left_out.items()))
        raise ModelError(
            f"{len(keys)} rides with measured energy to diagnose{f' ({why} left out)' if why else ''}, and it takes "
            f"{LEAST_RIDES}: give more rides"
        )
    vehicle = pd.factorize(table["vehicle_id"])[0].astype(np.int64)
    day = assign_vehicle_days(table)
    if day.max() + 1 < LEAST_DAYS:
        raise ModelError(
            f"all {len(keys)} rides are of {day.max() + 1} vehicle-days, and it takes {LEAST_DAYS} to distinguish "
            "cause from chance: give drives of more days or cars"
        )
    return Windows(
        table=table,
        rides=rides.set_index("ride_key", drop=False).loc[keys].reset_index(drop=True),
        measured=get_numbers(table, ENERGY),
        predicted=predicted,
        ride=ride.astype(np.int64),
        vehicle=vehicle,
        date=pd.factorize(pd.Series(get_names(table, "date")), sort=True)[0].astype(np.int64),
        day=day,
        left_out=dict(left_out),
    )


def _count_unmeasured(windows: pd.DataFrame, rides: pd.DataFrame, table: pd.DataFrame) -> int:
    """Return the number of windows of metered rides that have no metered energy."""
    of_rides = rides.loc[rides["ride_key"].isin(table["ride_key"])]
    metered = windows["ride_key"].isin(of_rides.loc[is_metered(of_rides), "ride_key"])
    return int(metered.sum()) - int(is_metered(table).sum())


def _check_model(model: LinearModel, table: pd.DataFrame) -> None:
    """Raise if a model was fitted to none of these vehicle models."""
    kinds = sorted(set(get_names(table, "vehicle_model")))
    if kinds and ANY not in model.fits and not set(kinds) & set(model.fits):
        raise ModelError(
            f"model {model.name} is of {', '.join(model.fits)}, and these rides are of {', '.join(kinds)}: "
            "give a model of these vehicles, or fit one"
        )
