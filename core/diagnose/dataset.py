"""Collect the windows to diagnose: those of rides fit for training, with the prediction of a model for each."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
import pandas as pd

from socast.core.batch import Floats, Ints
from socast.core.errors import ModelError
from socast.core.fit.measured_rows import join_tables
from socast.core.fit.measurement_noise import is_metered
from socast.core.fit.ride_blocks import ENERGY, assign_vehicle_days, get_names, get_numbers, select_trainable
from socast.core.models import ANY, LinearModel
from socast.core.models.features import Columns

LEAST_RIDES: Final = 20
"""Number of rides below which a diagnosis is not possible."""
LEAST_DAYS: Final = 6
"""Number of vehicle-days below which errors cannot be shown to be independent."""


@dataclass(frozen=True)
class Windows:
    """Hold windows ordered by vehicle and time, in columns of equal length.

    Parameters
    ----------
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


def gather_windows(rides: pd.DataFrame, windows: pd.DataFrame, model: LinearModel) -> Windows:
    """Return the windows to diagnose, with the predictions of a model."""
    if not len(rides):
        raise ModelError("there are no rides to diagnose: give tables or recordings that hold some")
    _, left_out = select_trainable(rides, [ENERGY])
    table = join_tables(rides, windows)
    _check_model(model, table)
    predicted = model.predict_energy(table) if len(table) else np.empty(0)
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
