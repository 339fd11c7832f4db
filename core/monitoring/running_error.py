"""Running errors of the models in service, and their reduction against the first model."""

from collections.abc import Sequence
from math import isfinite
from typing import Any, Final

import numpy as np

from socast.core.batch import Ints, grown, take_lanes
from socast.core.models import Model
from socast.core.stats.confidence_sequence import ClusterMoments
from socast.core.wire.messages import Gain, ModelErrors, RideErrors

NO_GROUP: Final = -1
"""Index for rides of a vehicle model without running errors of its own."""

VEHICLE_DAY: Final = np.dtype(
    [
        ("day", "f8"),  # UTC day of the rides
        ("group", "i8"),  # index of the vehicle model, or `NO_GROUP`
        ("rides", "i8"),  # number of rides
        ("reduction", "f8"),  # of the sum of absolute errors against the first model [kWh]
    ]
)
"""Rides of one vehicle on one day, a cluster of the confidence sequence."""

RIDE_SUMS: Final = np.dtype(
    [
        ("rides", "i8"),  # with a prediction
        ("unpredicted", "i8"),  # without a prediction
        ("absolute", "f8"),  # absolute error [kWh]
        ("error", "f8"),  # error [kWh]
        ("measured", "f8"),  # energy of the rides with a prediction [kWh]
    ]
)
"""Sums over rides."""


class RunningErrors:
    """Accumulate the errors of one model over rides of one vehicle model, or of all.

    Parameters
    ----------
    vehicle_model : str, optional
        Vehicle model of the rides; all rides without it.
    level : float, optional
        Probability with which the interval of the gain holds at all times. Without it there is no gain.
    """

    def __init__(self, vehicle_model: str | None, level: float | None) -> None:
        self.vehicle_model, self._level = vehicle_model, level
        self._sums = np.zeros((), RIDE_SUMS)
        self._clusters = ClusterMoments()
        self._published: RideErrors | None = None

    def add_ride(self, error: float, measured: float) -> None:
        """Add a ride.

        Units: measured [kWh].

        Parameters
        ----------
        error : float
            Predicted less measured energy, NaN without a prediction. [kWh]
        """
        self._published = None
        if not isfinite(error):
            self._sums["unpredicted"] += 1
            return
        self._sums["rides"] += 1
        self._sums["absolute"] += abs(error)
        self._sums["error"] += error
        self._sums["measured"] += measured

    def add_cluster(self, rides: int, reduction: float) -> None:
        """Add a vehicle-day that has ended, with the reduction of its absolute errors. [kWh]"""
        self._published = None
        self._clusters.add(rides, reduction)

    def get_errors(self) -> RideErrors:
        """Return the errors as published."""
        if self._published is None:
            rides, measured = int(self._sums["rides"]), float(self._sums["measured"])
            absolute, error = float(self._sums["absolute"]), float(self._sums["error"])
            self._published = RideErrors(
                vehicle_model=self.vehicle_model,
                rides=rides,
                unpredicted_rides=int(self._sums["unpredicted"]),
                mae_kwh=absolute / rides if rides else None,
                mae_pct=100.0 * absolute / measured if rides and measured > 0.0 else None,
                bias_kwh=error / rides if rides else None,
                gain=self._compute_gain(),
            )
        return self._published

    def _compute_gain(self) -> Gain | None:
        """Return by how much the error is smaller than that of the first model, None for the first model."""
        if self._level is None:
            return None
        clusters = self._clusters
        lower, upper = clusters.interval(self._level)
        known = isfinite(lower) and isfinite(upper)
        return Gain(
            rides=clusters.size,
            vehicle_days=clusters.count,
            mean_kwh=clusters.mean if clusters.count else None,
            lower_kwh=lower if known else None,
            upper_kwh=upper if known else None,
            verdict="better" if lower > 0.0 else "worse" if upper < 0.0 else "undecided",
        )

    def dump(self) -> Any:
        """Return the state as plain values."""
        return self._sums.tobytes(), self._clusters.state

    def load(self, state: Any) -> None:
        """Replace the state by one that `dump` returned."""
        sums, clusters = state
        self._sums = np.frombuffer(sums, RIDE_SUMS).reshape(()).copy()
        self._clusters = ClusterMoments(clusters)
        self._published = None


class ModelMonitor:
    """Follow the errors of one model: over all rides, by vehicle model, and in the vehicle-days in progress.

    Parameters
    ----------
    level : float, optional
        As for `RunningErrors`; None for the first model.

    Attributes
    ----------
    interval_outcomes : (3,) int
        Numbers of rides whose measured energy lies below, inside and above the model's own interval, if it has one.
    """

    def __init__(self, model: Model, level: float | None) -> None:
        self.model, self._level = model, level
        self.label = f"{model.name}/{model.version}"
        self._all = RunningErrors(None, level)
        self._by_group: list[RunningErrors] = []
        self._days = np.zeros(0, VEHICLE_DAY)  # in progress, by lane
        self.interval_outcomes: Ints = np.zeros(3, np.int64)

    def add_ride(
        self, lane: int, day: float, group: int | None, error: float, first_error: float, measured: float
    ) -> None:
        """Add a ride.

        Units: measured [kWh].

        Parameters
        ----------
        error, first_error : float
            Error of this model and of the first model, NaN without a prediction. [kWh]
        """
        for errors in self._list_errors(group):
            errors.add_ride(error, measured)
        if self._level is None:
            return
        self._days = grown(self._days, lane + 1)
        place = NO_GROUP if group is None else group
        present = self._days[lane]
        if present["rides"] and (present["day"] != day or present["group"] != place):
            self._end_day(lane)
        if isfinite(error) and isfinite(first_error):
            present["day"], present["group"] = day, place
            present["rides"] += 1
            present["reduction"] += abs(first_error) - abs(error)

    @property
    def unpredicted(self) -> int:
        """Number of rides that count and that this model did not predict."""
        return self._all.get_errors().unpredicted_rides

    def add_groups(self, names: Sequence[str]) -> None:
        """Add running errors for each vehicle model that has none."""
        self._by_group += [RunningErrors(name, self._level) for name in names[len(self._by_group) :]]

    def keep(self, lanes: Ints) -> None:
        """Keep the state of some lanes only, in their order, and end the vehicle-days of the others."""
        for lane in np.setdiff1d(np.flatnonzero(self._days["rides"]), lanes).tolist():
            self._end_day(lane)
        self._days = take_lanes(self._days, lanes)

    def close(self) -> None:
        """End the vehicle-days in progress."""
        for lane in np.flatnonzero(self._days["rides"]).tolist():
            self._end_day(lane)

    def get_errors(self, first: str, time: float) -> ModelErrors:
        """Return the errors as published."""
        by_group = [errors.get_errors() for errors in self._by_group]
        return ModelErrors(self.label, first, time, self._all.get_errors(), by_group)

    def dump(self) -> Any:
        """Return the state as plain values."""
        errors = [errors.dump() for errors in (self._all, *self._by_group)]
        return errors, self._days.tobytes(), self.interval_outcomes.tobytes()

    def load(self, state: Any) -> None:
        """Replace the state by one that `dump` returned, once the vehicle models are added."""
        errors, days, outcomes = state
        for part, dumped in zip((self._all, *self._by_group), errors, strict=True):
            part.load(dumped)
        self._days = np.frombuffer(days, VEHICLE_DAY).copy()
        self.interval_outcomes = np.frombuffer(outcomes, np.int64).copy()

    def _list_errors(self, group: int | None) -> tuple[RunningErrors, ...]:
        """Return the running errors to which a ride of a vehicle model contributes."""
        return (self._all,) if group is None else (self._all, self._by_group[group])

    def _end_day(self, lane: int) -> None:
        """Count a vehicle-day that has ended, and begin an empty one."""
        ended = self._days[lane]
        group = int(ended["group"])
        for errors in self._list_errors(None if group == NO_GROUP else group):
            errors.add_cluster(int(ended["rides"]), float(ended["reduction"]))
        self._days[lane] = np.zeros((), VEHICLE_DAY)
