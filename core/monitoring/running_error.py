"""How a model fares in service: running errors of its rides, and by how much they are below the first model's."""

from collections.abc import Sequence
from math import isfinite
from typing import Any, Final

import numpy as np

from core.batch import Floats, grown
from core.models import Model
from core.stats.confidence_sequence import ClusterMoments
from core.wire.messages import Gain, ModelErrors, RideErrors

_BOOK: Final = 4  # of a vehicle: day, vehicle model, rides and fall of the absolute error of the cluster in progress


class Score:
    """Running errors of a model over rides of one kind.

    Parameters
    ----------
    vehicle_model : str, optional
        Whose rides; all, where not given.
    level : float, optional
        Probability with which the interval of the gain holds at all times; without it there is no gain.
    state : sequence of (sequence of float, sequence of float), optional
        As `state` was.
    """

    def __init__(self, vehicle_model: str | None, level: float | None, state: Any = None) -> None:
        self.vehicle_model, self._level = vehicle_model, level
        # rides, rides without a prediction, sums of absolute error, of error and of measured energy
        self._sums: list[float] = list(state[0]) if state else [0.0] * 5
        self._clusters = ClusterMoments(state[1]) if state else ClusterMoments()
        self._told: RideErrors | None = None

    @property
    def state(self) -> Any:
        """From which another one goes on."""
        return [self._sums, self._clusters.state]

    def add(self, error: float, measured: float) -> None:
        """Take a ride, with an error of NaN where it was not predicted. [kWh]"""
        sums, self._told = self._sums, None
        if not isfinite(error):
            sums[1] += 1.0
            return
        for place, value in ((0, 1.0), (2, abs(error)), (3, error), (4, measured)):
            sums[place] += value

    def add_cluster(self, rides: int, fall: float) -> None:
        """Take a vehicle-day that has ended, and by how much its absolute errors fell. [kWh]"""
        self._told = None
        self._clusters.add(rides, fall)

    def errors(self) -> RideErrors:
        """Return what travels."""
        if self._told is None:
            rides, unpredicted, absolute, signed, measured = self._sums
            some = rides > 0
            self._told = RideErrors(
                vehicle_model=self.vehicle_model,
                rides=int(rides),
                unpredicted_rides=int(unpredicted),
                mae_kwh=absolute / rides if some else None,
                mae_pct=100.0 * absolute / measured if some and measured > 0.0 else None,
                bias_kwh=signed / rides if some else None,
                gain=self._gain(),
            )
        return self._told

    def _gain(self) -> Gain | None:
        """Return by how much the error is smaller than that of the first model."""
        if self._level is None:
            return None
        clusters = self._clusters
        lower, upper = clusters.interval(self._level)
        told = isfinite(lower) and isfinite(upper)
        return Gain(
            rides=clusters.size,
            vehicle_days=clusters.count,
            mean_kwh=clusters.mean if clusters.count else None,
            lower_kwh=lower if told else None,
            upper_kwh=upper if told else None,
            verdict="better" if lower > 0.0 else "worse" if upper < 0.0 else "not told",
        )


class Standing:
    """How one model fares: over all rides, by vehicle model, and in the vehicle-days in progress.

    Parameters
    ----------
    model : Model
    level : float, optional
        As `Score` has it; None for the first model.
    """

    def __init__(self, model: Model, level: float | None) -> None:
        self.model, self._level = model, level
        self.label = f"{model.name}/{model.version}"
        self._all = Score(None, level)
        self._scores: list[Score] = []
        self._books: Floats = np.zeros((0, _BOOK))

    def add(self, lane: int, day: float, group: int | None, error: float, first: float, measured: float) -> None:
        """Take a ride: its vehicle, day and vehicle model, the errors of this model and of the first, its energy."""
        for score in self._of(group):
            score.add(error, measured)
        if self._level is None:
            return
        self._books = grown(self._books, lane + 1)
        book = self._books[lane]
        code = -1.0 if group is None else float(group)
        if book[2] and (book[0] != day or book[1] != code):
            self._end(book)
        if isfinite(error) and isfinite(first):
            book[:] = day, code, book[2] + 1.0, book[3] + (abs(first) - abs(error))

    @property
    def unpredicted(self) -> int:
        """How many of the rides that count it did not predict."""
        return self._all.errors().unpredicted_rides

    def open_groups(self, names: Sequence[str]) -> None:
        """Make a score for each vehicle model that has none."""
        self._scores += [Score(name, self._level) for name in names[len(self._scores) :]]

    def close(self) -> None:
        """End the vehicle-days in progress."""
        for book in self._books[self._books[:, 2] > 0.0]:
            self._end(book)
        self._books[:] = 0.0

    def errors(self, first: str, time: float) -> ModelErrors:
        """Return what travels."""
        return ModelErrors(self.label, first, time, self._all.errors(), [score.errors() for score in self._scores])

    def dump(self) -> Any:
        """Return the state as plain lists."""
        return [[score.state for score in (self._all, *self._scores)], self._books.tobytes()]

    def load(self, state: Any, names: Sequence[str]) -> None:
        """Take up a state that `dump` returned, made with the vehicle models of these names."""
        scores, books = state
        self._all, *self._scores = (
            Score(name, self._level, score) for name, score in zip((None, *names), scores, strict=True)
        )
        self._books = np.frombuffer(books).reshape(-1, _BOOK).copy()

    def _of(self, group: int | None) -> tuple[Score, ...]:
        """Return the scores that a ride of a vehicle model counts for."""
        return (self._all,) if group is None else (self._all, self._scores[group])

    def _end(self, book: Floats) -> None:
        """Count a vehicle-day that has ended, and begin an empty one."""
        _, code, rides, fall = book.tolist()
        for score in self._of(None if code < 0.0 else int(code)):
            score.add_cluster(int(rides), fall)
        book[:] = 0.0
