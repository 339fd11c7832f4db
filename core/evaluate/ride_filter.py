"""Select the rides that are evaluated, count the others by reason, and assign distance clusters.

The filter and the clusters are those of section 3 of the paper.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import pandas as pd

from socast.core.batch import Floats
from socast.core.errors import ModelError
from socast.core.formatting import format_count
from socast.core.models.features import ANSWERS
from socast.core.stats.scores import Codes

CLUSTER_KM: Final = 5.0
"""Width of a distance cluster, from section 3 of the paper; a cluster includes its lower edge. [km]"""
CLUSTERS: Final = ("0-5", "5-10", "10-15", "15-20", "20-25", "25-30", "30+")
"""Labels of the distance clusters of Tables 2 and 3. [km]"""
SCORED_CLUSTERS: Final = 5
"""Number of leading clusters that Tables 4 to 11 cover."""
LEAST_RIDES: Final = 10
"""Rides that a vehicle model needs in a cluster for its error to be reported."""
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
"""Columns of the ride table that every evaluation needs, in addition to those that models read."""
NUMERIC_COLUMNS: Final = ("start_s", "winter", "distance_km", "ambient_c", "energy_kwh")
"""The needed columns that hold numbers."""
RIDE_NAME_COLUMNS: Final = ("ride_key", "ride_id")
"""Columns that name a ride, in order of preference."""
IDENTITY_COLUMNS: Final = ("vehicle_id", "start_s", "distance_km", "energy_kwh")
"""Columns that identify a ride.

Rides that agree in all of them are one ride that was read twice; it must not be on both sides of a split.
"""


@dataclass(frozen=True)
class EvaluatedRides:
    """Hold the rides on which models are trained and tested.

    Parameters
    ----------
    rides : (n, columns) DataFrame
        Rides that are fit for training, sorted by vehicle and time, so that results do not depend on the order of
        files.
    model : (n,) int64
        Position of each ride's vehicle model in `vehicle_models`.
    cluster : (n,) int64
        Position of each ride's distance cluster in `CLUSTERS`.
    energy : (n,) float
        Measured energy. [kWh]
    """

    rides: pd.DataFrame
    read: int
    unfit: dict[str, int]
    vehicle_models: tuple[str, ...]
    model: Codes
    cluster: Codes
    energy: Floats

    def count(self) -> Codes:
        """Return the number of rides by vehicle model and cluster, (vehicle models, clusters)."""
        shape = (len(self.vehicle_models), len(CLUSTERS))
        return np.bincount(self.model * shape[1] + self.cluster, minlength=shape[0] * shape[1]).reshape(shape)

    def drop_answers(self) -> pd.DataFrame:
        """Return the rides without the columns that hold the measured energy."""
        return self.rides.drop(columns=[name for name in self.rides if str(name).startswith(ANSWERS)])


def filter_rides(rides: pd.DataFrame) -> EvaluatedRides:
    """Return the rides of a table that can be evaluated."""
    reason = find_exclusion_reasons(rides)
    kept = rides[reason.isna()].sort_values(["vehicle_id", "start_s"], kind="stable", ignore_index=True)
    unfit = {str(why): int(n) for why, n in reason.value_counts().sort_index().items()}
    names = sorted(kept["vehicle_model"].unique())
    evaluated = EvaluatedRides(
        rides=kept,
        read=len(rides),
        unfit=unfit,
        vehicle_models=tuple(names),
        model=pd.Categorical(kept["vehicle_model"], categories=names).codes.astype(np.int64),
        cluster=assign_distance_clusters(kept["distance_km"].to_numpy(np.float64)),
        energy=kept["energy_kwh"].to_numpy(np.float64),
    )
    most = int(evaluated.count()[:, :SCORED_CLUSTERS].max(initial=0))
    if most < LEAST_RIDES:
        reasons = ", ".join(f"{n:,} {why.replace('_', ' ')}" for why, n in unfit.items()) or "none"
        raise ModelError(
            f"{len(kept):,} of {format_count(len(rides), 'ride')} can be evaluated, at most {most} of a vehicle model "
            f"in a cluster of {CLUSTER_KM:g} km, and it takes {LEAST_RIDES}: give more rides (left out: {reasons})"
        )
    return evaluated


def compute_instrument_shares(rides: pd.DataFrame) -> dict[str, float | None]:
    """Return the share of rides whose energy was measured by voltage and current, and by the state of charge. [1]"""
    return {
        name: float((rides["energy_kwh"] == rides[f"energy_{name}_kwh"]).mean())
        for name in ("vi", "soc")
        if f"energy_{name}_kwh" in rides
    }


def name_rides(rides: pd.DataFrame) -> list[str]:
    """Return the name of each ride, as every report shows it: `vehicle#ride`.

    Parameters
    ----------
    rides : (n, columns) DataFrame
        Rides. The name is the column `ride_key`; without it the logger's `ride_id`, and without both the index.

    Examples
    --------
    >>> name_rides(pd.DataFrame({"ride_id": ["morning"], "ride_key": ["taxi-005#1"]}))
    ['taxi-005#1']
    """
    column = next((name for name in RIDE_NAME_COLUMNS if name in rides), None)
    return (rides.index.to_series() if column is None else rides[column]).astype(str).tolist()


def assign_distance_clusters(distance_km: Floats) -> Codes:
    """Return the distance cluster of each ride, as a position in `CLUSTERS`.

    Examples
    --------
    >>> [CLUSTERS[i] for i in assign_distance_clusters(np.array([0.4, 4.99, 5.0, 31.0, 400.0]))]
    ['0-5', '0-5', '5-10', '30+', '30+']
    """
    return np.clip(distance_km // CLUSTER_KM, 0, len(CLUSTERS) - 1).astype(np.int64)


def find_exclusion_reasons(rides: pd.DataFrame) -> "pd.Series[Any]":
    """Return the reason why each ride is excluded; NaN where it is not."""
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
    """Return where all of some columns are finite numbers."""
    try:
        values = rides[list(names)].to_numpy(np.float64)
    except (TypeError, ValueError) as error:
        raise ModelError(f"column {names[0]!r} of the ride table holds no numbers: {error}") from error
    return pd.Series(np.isfinite(values).all(axis=1), index=rides.index)
