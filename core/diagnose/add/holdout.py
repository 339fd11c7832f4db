"""Compare the errors of a model before and after an addition, on held-out days and vehicles.

Both models are refitted in each fold to the same windows, and their errors are compared ride by ride. What makes a ride
difficult affects both models and cancels. Rides of one vehicle on one day share weather, driver and load, so the
interval of the mean difference allows their errors to depend on each other.

With at least `LEAST_DATES` dates, whole days of all vehicles are held out. With fewer dates, leaving one out would
leave a season out, so single vehicle-days are held out. Vehicles are held out as a whole. A vehicle of a vehicle model
with fewer than `OWN_FIT` vehicles is predicted by the fit to all vehicle models.
"""

from collections.abc import Collection, Mapping, Sequence
from itertools import pairwise
from typing import Any, Final, NamedTuple
from zlib import crc32

import numpy as np
import pandas as pd
from msgspec.structs import asdict
from numpy.typing import NDArray

from socast.core.batch import Floats, Ints
from socast.core.diagnose.add.error_fall import measure_fall
from socast.core.diagnose.add.records import ConditionErrorFall, ErrorFall, list_attempts
from socast.core.diagnose.add.refit import TermAddition, hide_vehicle_models, refit_with
from socast.core.errors import ModelError
from socast.core.fit.measurement_noise import compute_noise_variance
from socast.core.fit.ride_blocks import ENERGY, assign_vehicle_days, get_names, get_numbers
from socast.core.models import VEHICLE_MODEL
from socast.core.stats.splits import deal_names, split_by_vehicle

FOLDS: Final = 5
LEAST_DATES: Final = 20
"""Number of dates from which on whole days are held out, and some are the final hold-out."""
OWN_FIT: Final = 4
"""Number of vehicles of a vehicle model from which on a held-out vehicle is predicted by the fit of the others."""

Mask = NDArray[np.bool_]


class RideRows(NamedTuple):
    """Hold rows to fit to, and the rides to which they belong.

    Parameters
    ----------
    ride : (n,) int64
        Ride of each row.
    table : (rides,) DataFrame
        `vehicle_id`, `vehicle_model`, `date`, `measured` [kWh], `noise` (variance of `measured`) [kWh^2],
        `distance_km`, `speed_kmh`, `ambient_c`.
    """

    rows: pd.DataFrame
    ride: Ints
    table: pd.DataFrame

    def by_ride(self, values: Floats) -> Floats:
        """Return the sum of row values over each ride, (rides,)."""
        return sum_groups(self.ride, values, len(self.table))

    def only(self, kept: Mask) -> "RideRows":
        """Return a part of the rides with their rows."""
        place = np.cumsum(kept) - 1
        at = kept[self.ride]
        return RideRows(
            self.rows.loc[at].reset_index(drop=True), place[self.ride[at]].astype(np.int64), self.table.loc[kept]
        )

    @property
    def dates(self) -> list[str]:
        """ISO date of each ride."""
        return get_names(self.table, "date")


def sum_groups(group: Ints, values: Floats, count: int) -> Floats:
    """Return the sum of the values of each group, (count,)."""
    return np.bincount(group, values, count).astype(np.float64)


def group_rows_by_ride(rows: pd.DataFrame, rides: pd.DataFrame | None = None) -> RideRows:
    """Return rows grouped by the rides to which they belong.

    Parameters
    ----------
    rides : DataFrame, optional
        The ride table, for the measurement noise of whole rides. By default, the variances of the windows are summed.
    """
    if not len(rows):
        raise ModelError("no ride with measured energy that is fit for training: give more rides")
    code, keys = pd.factorize(rows["ride_key"])
    ride = code.astype(np.int64)
    first = np.unique(ride, return_index=True)[1]
    table = rows.iloc[first][["vehicle_id", VEHICLE_MODEL, "date"]].reset_index(drop=True)

    def total(values: Floats) -> Floats:
        return sum_groups(ride, values, len(keys))

    duration, distance = get_numbers(rows, "duration_s"), total(get_numbers(rows, "distance_km"))
    known = np.maximum(total(duration), 1e-9)
    noise = total(compute_noise_variance(rows))
    if rides is not None and "ride_key" in rides:
        noise = compute_noise_variance(rides.set_index("ride_key").reindex(keys))
    return RideRows(
        rows,
        ride,
        table.assign(
            measured=total(get_numbers(rows, ENERGY)),
            noise=noise,
            distance_km=distance,
            speed_kmh=distance / known * 3600.0,
            ambient_c=total(get_numbers(rows, "ambient_c") * duration) / known,
        ),
    )


def split_into_day_folds(rides: RideRows, seed: int) -> list[Mask]:
    """Return parts of the rides to hold out in turn: whole days, or vehicle-days where there are few dates."""
    days = rides.dates
    if len(set(days)) < LEAST_DATES:
        days = [f"{vehicle} {day}" for vehicle, day in zip(get_names(rides.table, "vehicle_id"), days, strict=True)]
    fold = deal_names(days, FOLDS, [seed, crc32(b"days")])
    return [fold == i for i in range(int(fold.max()) + 1)] if fold.any() else []


def split_into_vehicle_folds(rides: RideRows, seed: int) -> list[Mask]:
    """Return parts of the rides to hold out in turn, by vehicle; none where there is only one vehicle."""
    kinds, vehicles = get_names(rides.table, VEHICLE_MODEL), get_names(rides.table, "vehicle_id")
    few = list_sparse_vehicle_models(rides.table)
    pooled = ["" if kind in few else kind for kind in kinds]
    every = np.arange(len(kinds))
    masks = [np.isin(every, split.test) for split in split_by_vehicle(pooled, vehicles, seed, FOLDS)]
    return [mask for mask in masks if not mask.all()]


def list_sparse_vehicle_models(table: pd.DataFrame) -> set[str]:
    """Return the vehicle models with too few vehicles to hold one of them out."""
    count = table.groupby(VEHICLE_MODEL)["vehicle_id"].nunique()
    return {str(name) for name, n in count.items() if n < OWN_FIT}


def predict_held_out(
    change: TermAddition, rides: RideRows, folds: Sequence[Mask], pooled: Collection[str] = ()
) -> tuple[Floats, Floats]:
    """Return predictions of rides by models that are fitted without them: one without and one with an added term.

    Returns
    -------
    before, after : (rides,) float
        Predictions without and with the term; NaN for rides in no fold. [kWh]
    """
    before, after = (np.full(len(rides.table), np.nan) for _ in range(2))
    for fold in folds:
        test = rides.only(fold)
        rows = hide_vehicle_models(test.rows, pooled)
        models = refit_with(change, rides.only(~fold).rows, pooled=pooled)
        before[fold] = test.by_ride(models.before.predict_energy(rows))
        after[fold] = test.by_ride(models.after.predict_energy(rows))
    return before, after


def compare_errors(table: pd.DataFrame, before: Floats, after: Floats) -> ErrorFall:
    """Return the errors of two models on the same rides, and how far the second one is nearer to the noise.

    Units: table [kWh], before [kWh], after [kWh].
    """
    known = np.isfinite(before) & np.isfinite(after)
    measured, noise = (get_numbers(table, name)[known] for name in ("measured", "noise"))
    clusters = assign_vehicle_days(table.loc[known])
    return measure_fall(measured, before[known], after[known], noise, clusters)


APART: Final = 5
"""One in this number of dates is a final hold-out day."""
CONDITIONS: Final = {
    "ambient_c": ("outside temperature", (-10.0, 0.0, 10.0, 20.0), "°C"),
    "distance_km": ("distance", (2.0, 5.0, 10.0, 20.0), "km"),
    "speed_kmh": ("average speed", (15.0, 30.0, 50.0), "km/h"),
}
"""Column of the rides -> its title, the edges of its bins, and its unit."""
LEAST: Final = 10
"""Number of rides from which on a bin is reported."""


def compare_by_condition(table: pd.DataFrame, before: Floats, after: Floats) -> dict[str, list[ConditionErrorFall]]:
    """Return the comparison by temperature, distance, speed and vehicle, for bins with at least `LEAST` rides."""
    bins = {what: _bins(get_numbers(table, column), cuts, unit) for column, (what, cuts, unit) in CONDITIONS.items()}
    vehicles = np.array(get_names(table, "vehicle_id"), dtype=object)
    bins["vehicle"] = [(str(name), vehicles == name) for name in sorted(set(vehicles))]
    return {
        what: [
            ConditionErrorFall(where=label, **asdict(compare_errors(table.loc[here], before[here], after[here])))
            for label, here in parts
            if here.sum() >= LEAST
        ]
        for what, parts in bins.items()
    }


def _bins(values: Floats, cuts: tuple[float, ...], unit: str) -> list[tuple[str, Mask]]:
    """Return the titles of bins and the rides in each; a lower edge belongs to its bin."""
    code = np.where(np.isfinite(values), np.searchsorted(cuts, values, side="right"), -1)
    ends = [f"{cut:g}" for cut in cuts]
    middle = [f"{low} to {high} {unit}" for low, high in pairwise(ends)]
    labels = [f"below {ends[0]} {unit}", *middle, f"from {ends[-1]} {unit}"]
    return [(label, code == i) for i, label in enumerate(labels)]


def select_final_days(history: Sequence[Mapping[str, Any]], dates: Sequence[str]) -> tuple[str, ...]:
    """Return the final hold-out days; none of fewer than `LEAST_DATES` dates, because all of these are needed.

    They are those in the history of the model if the rides have any of them, else every fifth date. The last fifth of
    the dates would be of one season, and effects of that season could be neither found nor evaluated.

    Examples
    --------
    >>> select_final_days((), [f"2018-01-{day:02d}" for day in range(1, 21)])
    ('2018-01-03', '2018-01-08', '2018-01-13', '2018-01-18')
    """
    there = sorted({date for date in dates if date})
    for attempt in reversed(list_attempts(history)):
        if attempt.final and set(attempt.final.dates) & set(there):
            return attempt.final.dates
    return tuple(there[APART // 2 :: APART]) if len(there) >= LEAST_DATES else ()


def drop_dates(rides: pd.DataFrame, windows: pd.DataFrame, dates: Collection[str]) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Return the ride table and the window table without the rides of some dates."""
    if not dates:
        return rides, windows
    kept = rides.loc[~np.isin(np.asarray(get_names(rides, "date"), dtype=str), list(dates))]
    return kept, windows.loc[windows["ride_key"].isin(kept["ride_key"])]
