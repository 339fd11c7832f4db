"""The rides that are judged: filtered as section 3 of the paper, counted by reason, in clusters of distance."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import pandas as pd

from core.batch import Floats
from core.errors import ModelError
from core.models.features import ANSWERS
from core.stats.scores import Codes

CLUSTER_KM: Final = 5.0
"""Width of a cluster, section 3 of the paper; the lower end belongs to it. [km]"""
CLUSTERS: Final = ("0-5", "5-10", "10-15", "15-20", "20-25", "25-30", "30+")
"""Of Tables 2 and 3. [km]"""
SCORED_CLUSTERS: Final = 5
"""The first ones, which Tables 4 to 11 have."""
LEAST_RIDES: Final = 10
"""Rides of a vehicle model in a cluster for its error to be given."""
NEEDED_COLUMNS: Final = (
    "vehicle_id",
    "vehicle_model",
    "date",
    "start_s",
    "winter",
    "distance_km",
    "ambient_c",
    "energy_kwh",
    "fit_for_training",
    "unfit_reason",
)
"""Columns of the ride table that judging needs, whatever the models need."""
NUMERIC_COLUMNS: Final = ("start_s", "winter", "distance_km", "ambient_c", "energy_kwh")
"""Those of them that are numbers."""
RIDE_NAME_COLUMNS: Final = ("ride_key", "ride_id")
"""Columns that name a ride, in the order of preference."""
IDENTITY_COLUMNS: Final = ("vehicle_id", "start_s", "distance_km", "energy_kwh")
"""Rides that agree in these are one ride that was read twice; it must not be on both sides of a split."""


@dataclass(frozen=True)
class EvaluatedRides:
    """Rides that models are trained and tested on.

    Parameters
    ----------
    rides : DataFrame
        Those that are fit, by car and time, so that the order of the files tells nothing.
    read : int
        Rides read.
    unfit : dict of str to int
        Rides left out, by reason.
    vehicle_models : tuple of str
        Sorted.
    model : (n,) int64
        Position in `vehicle_models` of each ride's.
    cluster : (n,) int64
        Position in `CLUSTERS` of each ride's.
    energy : (n,) float
        Measured. [kWh]
    """

    rides: pd.DataFrame
    read: int
    unfit: dict[str, int]
    vehicle_models: tuple[str, ...]
    model: Codes
    cluster: Codes
    energy: Floats

    def count(self) -> Codes:
        """Return the rides of each vehicle model in each cluster, (vehicle models, clusters)."""
        shape = (len(self.vehicle_models), len(CLUSTERS))
        return np.bincount(self.model * shape[1] + self.cluster, minlength=shape[0] * shape[1]).reshape(shape)

    def questions(self) -> pd.DataFrame:
        """Return the rides without the columns that hold the answer."""
        return self.rides.drop(columns=[name for name in self.rides if str(name).startswith(ANSWERS)])


def filter_rides(rides: pd.DataFrame) -> EvaluatedRides:
    """Return what of a ride table can be judged.

    Parameters
    ----------
    rides : DataFrame
        As `core.totals.tables.ride_table` makes it.

    Raises
    ------
    ModelError
        Where a column is missing, or no cluster of any vehicle model has enough rides.
    """
    reason = find_exclusion_reasons(rides)
    kept = rides[reason.isna()].sort_values(["vehicle_id", "start_s"], kind="stable", ignore_index=True)
    unfit = {str(why): int(n) for why, n in reason.value_counts().sort_index().items()}
    names = sorted(kept["vehicle_model"].unique())
    found = EvaluatedRides(
        rides=kept,
        read=len(rides),
        unfit=unfit,
        vehicle_models=tuple(names),
        model=pd.Categorical(kept["vehicle_model"], categories=names).codes.astype(np.int64),
        cluster=assign_distance_clusters(kept["distance_km"].to_numpy(np.float64)),
        energy=kept["energy_kwh"].to_numpy(np.float64),
    )
    most = int(found.count()[:, :SCORED_CLUSTERS].max(initial=0))
    if most < LEAST_RIDES:
        told = ", ".join(f"{n:,} {why.replace('_', ' ')}" for why, n in unfit.items()) or "none"
        raise ModelError(
            f"{len(kept):,} of {len(rides):,} rides can be judged, at most {most} of a vehicle model in a cluster of "
            f"{CLUSTER_KM:g} km, and it takes {LEAST_RIDES}: give more rides (left out: {told})"
        )
    return found


def name_rides(rides: pd.DataFrame) -> list[str]:
    """Return the name of each ride, as every report shows it: `vehicle#ride`.

    Parameters
    ----------
    rides : (n, columns) DataFrame
        Rides. The name is the column `ride_key`; without it the logger's `ride_id`, and without both the index.

    Returns
    -------
    list of n str

    Examples
    --------
    >>> name_rides(pd.DataFrame({"ride_id": ["morning"], "ride_key": ["taxi-005#1"]}))
    ['taxi-005#1']
    """
    column = next((name for name in RIDE_NAME_COLUMNS if name in rides), None)
    return (rides.index.to_series() if column is None else rides[column]).astype(str).tolist()


def assign_distance_clusters(distance_km: Floats) -> Codes:
    """Return the cluster of each distance, as a position in `CLUSTERS`.

    Examples
    --------
    >>> [CLUSTERS[i] for i in assign_distance_clusters(np.array([0.4, 4.99, 5.0, 31.0, 400.0]))]
    ['0-5', '0-5', '5-10', '30+', '30+']
    """
    return np.clip(distance_km // CLUSTER_KM, 0, len(CLUSTERS) - 1).astype(np.int64)


def find_exclusion_reasons(rides: pd.DataFrame) -> "pd.Series[Any]":
    """Return why each ride is left out, NaN where it is not.

    Raises
    ------
    ModelError
        Where a column is missing, or holds no numbers.
    """
    if missing := [name for name in NEEDED_COLUMNS if name not in rides]:
        raise ModelError(f"column {missing[0]!r} is missing in the ride table: make it with `socast tables`")
    for name in NUMERIC_COLUMNS:
        _finite(rides, (name,))
    reason = rides["unfit_reason"].where(~rides["fit_for_training"].astype(bool), None).astype(object)
    reason[reason.isna() & ~rides["fit_for_training"].astype(bool)] = "unfit"
    for why, applies in (
        ("no_vehicle_model", rides["vehicle_model"].isna()),
        ("no_measured_energy", ~_finite(rides, ("energy_kwh",))),
        ("no_distance_or_time", ~_finite(rides, ("distance_km", "start_s"))),
        ("twice", rides.duplicated(list(IDENTITY_COLUMNS))),
    ):
        reason[reason.isna() & applies] = why
    return reason


def _finite(rides: pd.DataFrame, names: Sequence[str]) -> "pd.Series[bool]":
    """Return where all columns are finite numbers."""
    try:
        values = rides[list(names)].to_numpy(np.float64)
    except (TypeError, ValueError) as error:
        raise ModelError(f"column {names[0]!r} of the ride table holds no numbers: {error}") from error
    return pd.Series(np.isfinite(values).all(axis=1), index=rides.index)
