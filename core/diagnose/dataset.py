"""What is diagnosed: the windows of rides fit for training, with what a model says of each.

A ride total hides when the error happened, so diagnosis goes by windows of about a minute where voltage and current are
measured. Where only the state of charge is, a window lasts until that ticks, so that what a model does not know of
shortens the very window that it is looked for in, and biases all that is fitted to it. Then the ride, whose ends do not
depend on what it takes, stands for its windows as one. And a ride by meter is by meter in all its windows: to take
whichever is surer, window by window, would choose them by what they take.
"""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import msgspec
import numpy as np
import pandas as pd
from numpy.typing import NDArray

from core.batch import Floats, Ints
from core.errors import ModelError
from core.fit.calibration import add_interval
from core.fit.fitting import fit_terms
from core.fit.recipes import LinearRecipe, get_recipe
from core.fit.ride_blocks import ENERGY, RideFrame, get_names, get_numbers, select_trainable
from core.models import ANY, LinearModel
from core.models.features import Columns

RIDE_COLUMNS: Final = ("ride_id", "date", "winter", "summer", "fit_for_training", "unfit_reason")
"""Columns of the ride table that its windows are given."""
ENERGY_SD: Final = "energy_sd_kwh"
LEAST_RIDES: Final = 20
"""Rides below which nothing can be said of what a model lacks."""
LEAST_DAYS: Final = 6
"""Vehicle-days below which errors cannot be told to be independent."""


@dataclass(frozen=True)
class Windows:
    """Windows in order of vehicle and time, equally long columns.

    Parameters
    ----------
    table : (n, columns) DataFrame
        The window table, with `OF_THE_RIDE`.
    rides : (rides, columns) DataFrame
        The ride table of the same rides, in the order of `ride`.
    measured, predicted : (n,) float
        Energy of each window. [kWh]
    ride, vehicle, date, day : (n,) int64
        Codes: of the ride, of its vehicle, of its date, and of the two together, a vehicle-day.
    left_out : mapping of str to int
        Rides that are not diagnosed, by reason.
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
        """Return the sum of each ride, (rides,)."""
        return np.asarray(np.bincount(self.ride, values, len(self.rides)), dtype=np.float64)


def join_tables(rides: pd.DataFrame, windows: pd.DataFrame) -> pd.DataFrame:
    """Return what is measured of rides fit for training: their windows, or the ride itself where no meter measures.

    Parameters
    ----------
    rides, windows : DataFrame
        As `core.totals.tables` makes them, of the same recordings.

    Returns
    -------
    DataFrame
        In order of vehicle and time, with `OF_THE_RIDE`.

    Raises
    ------
    ModelError
        Where the tables are not of the same rides, or a column is missing.
    """
    for table, what in ((rides, "ride"), (windows, "window")):
        if lacking := [name for name in ("ride_key", "vehicle_id", "start_s", ENERGY) if name not in table]:
            raise ModelError(f"the {what} table has no column {lacking[0]!r}: make the tables anew, `socast tables`")
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
    own = {name: rides[name].to_numpy()[place] for name in RIDE_COLUMNS if name in rides}
    own |= {ENERGY: get_numbers(windows, "energy_vi_kwh"), ENERGY_SD: get_numbers(windows, "energy_vi_sd_kwh")}
    kept = (
        (place >= 0) & (good & by_power)[place] & np.isfinite(own[ENERGY]) & (get_numbers(windows, "duration_s") > 0.0)
    )
    others = windows.drop(columns=[name for name in own if name in windows])
    parts = pd.concat([others, pd.DataFrame(own, index=windows.index)], axis=1).loc[kept]
    whole = rides.loc[good & ~by_power, [name for name in parts.columns if name in rides]]
    table = pd.concat([parts, whole], ignore_index=True) if len(whole) else parts
    begin = table.groupby("ride_key", sort=False)["start_s"].transform("min")  # clocks that step interleave rides
    order = np.lexsort((get_numbers(table, "start_s"), pd.factorize(table["ride_key"])[0], begin))
    return table.iloc[order].sort_values("vehicle_id", kind="stable", ignore_index=True)


def is_metered(table: pd.DataFrame) -> NDArray[np.bool_]:
    """Return which rides or windows are measured by voltage and current, not by the state of charge, (n,)."""
    return np.asarray(get_numbers(table, ENERGY) == get_numbers(table, "energy_vi_kwh"))


def fit_to_windows(name: str, rides: pd.DataFrame, windows: pd.DataFrame, *, covariance: bool = True) -> LinearModel:
    """Return a recipe of linear terms fitted to windows in place of rides.

    Windows tell apart what rides only add up: the energy of speeding up and of slowing, the minute from the kilometre.

    Raises
    ------
    ModelError
        For a recipe that is not one of linear terms, and where `joined` or the fit raises.
    """
    chosen = get_recipe(name)
    if not isinstance(chosen, LinearRecipe):
        raise ModelError(f"recipe {name} cannot be fitted to windows: choose road_load or one of the paper's")
    table = join_tables(rides, windows)
    model = _counted(fit_terms(chosen, RideFrame(table), covariance=covariance), table, rides)
    return add_interval(model, rides) if covariance else model


def _counted(model: LinearModel, table: pd.DataFrame, rides: pd.DataFrame) -> LinearModel:
    """Return a model fitted to windows that tells of the rides that they are of: how many, and how far off."""
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
    """Return what is to be diagnosed.

    Raises
    ------
    ModelError
        Where there are too few rides or vehicle-days, none has a measured energy, or the model knows none of the
        vehicle models.
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
    if unmeasured := _unmeasured(windows, rides, table):
        left_out["windows without voltage and current"] = unmeasured
    if len(keys) < LEAST_RIDES:
        why = ", ".join(f"{n:,} {reason.replace('_', ' ')}" for reason, n in sorted(left_out.items()))
        raise ModelError(
            f"{len(keys)} rides with measured energy to diagnose{f' ({why} left out)' if why else ''}, and it takes "
            f"{LEAST_RIDES}: give more rides"
        )
    vehicle = pd.factorize(table["vehicle_id"])[0].astype(np.int64)
    day = pd.factorize(pd.Series(get_names(table, "vehicle_id")) + " " + pd.Series(get_names(table, "date")))[0]
    if day.max() + 1 < LEAST_DAYS:
        raise ModelError(
            f"all {len(keys)} rides are of {day.max() + 1} vehicle-days, and it takes {LEAST_DAYS} to tell chance from "
            "cause: give drives of more days or cars"
        )
    return Windows(
        table=table,
        rides=rides.set_index("ride_key", drop=False).loc[keys].reset_index(drop=True),
        measured=get_numbers(table, ENERGY),
        predicted=predicted,
        ride=ride.astype(np.int64),
        vehicle=vehicle,
        date=pd.factorize(pd.Series(get_names(table, "date")), sort=True)[0].astype(np.int64),
        day=day.astype(np.int64),
        left_out=dict(left_out),
    )


def _unmeasured(windows: pd.DataFrame, rides: pd.DataFrame, table: pd.DataFrame) -> int:
    """Return how many windows of rides by meter are left out, as the meter was silent."""
    own = rides.loc[rides["ride_key"].isin(table["ride_key"])]
    metered = windows["ride_key"].isin(own.loc[is_metered(own), "ride_key"])
    return int(metered.sum()) - int(is_metered(table).sum())


def _check_model(model: LinearModel, table: pd.DataFrame) -> None:
    """Refuse a model that has nothing to say of these vehicles."""
    kinds = sorted(set(get_names(table, "vehicle_model")))
    if kinds and ANY not in model.fits and not set(kinds) & set(model.fits):
        raise ModelError(
            f"model {model.name} is of {', '.join(model.fits)}, and these rides are of {', '.join(kinds)}: "
            "give a model of these vehicles, or fit one"
        )
