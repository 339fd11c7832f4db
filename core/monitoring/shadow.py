"""Models in service side by side: what each predicts of rides, on the same sums.

The first model makes the forecasts; the others run in its shadow. An effect that a shadow has and the first has not
proves itself here before it is switched on.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from math import isfinite
from typing import Any, Final, NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from core.batch import Floats, Ints
from core.columns import SECONDS_PER_DAY
from core.effects.declaration import Effect
from core.errors import ModelError
from core.models import Model
from core.monitoring.running_error import Standing
from core.signals.signals import Signals
from core.stats.confidence_sequence import LEVEL
from core.totals.accumulator import Totals
from core.totals.context import RunContext
from core.totals.tables import measured_energy, model_columns
from core.wire.messages import Message, ModelErrors, encode, model_identity

MOST_VEHICLE_MODELS: Final = 64
"""Vehicle models that have running errors of their own; rides of those met later count among all only."""


class Ended(NamedTuple):
    """Rides that have ended, are fit for training and have a measured energy.

    Parameters
    ----------
    lane : (n,) int64
    start, end : (n,) float64. [s]
    vehicle_model : list of n (str or None)
    measured : (n,) float64. [kWh]
    predicted : list of (n,) float64. By each model, NaN where it cannot tell. [kWh]
    """

    lane: Ints
    start: Floats
    end: Floats
    vehicle_model: list[str | None]
    measured: Floats
    predicted: list[Floats]


class Shadows:
    """The models in service, and how each fares; of no cost where there is but one.

    Parameters
    ----------
    models : sequence of Model
        The first makes the forecasts.
    prefix : str
        Chunks before `models` in the keys, with a slash at the end.
    keep : bool
        Keep what is to be told until it is asked for.

    Raises
    ------
    ModelError
        Where two models have the same name and version.

    Notes
    -----
    Intervals hold for all shadows together: each is made at 1 - 0.05 / shadows. Those by vehicle model hold for each
    vehicle model by itself. They speak of the days driven: a season that was not driven is not judged.
    """

    def __init__(self, models: Sequence[Model], prefix: str = "", *, keep: bool = True) -> None:
        others = len(models) - 1
        level = 1.0 - (1.0 - LEVEL) / max(1, others)
        self._prefix, self._keep = prefix, keep
        self.standings = [Standing(model, level if place else None) for place, model in enumerate(models)]
        self._check()
        self.faults: Counter[str] = Counter()
        self._time = float("nan")
        self._groups: list[str] = []
        self._due: list[ModelErrors] = []

    def __len__(self) -> int:
        """Return how many run beside the first."""
        return len(self.standings) - 1

    def predictions(self, totals: Totals, context: RunContext) -> list[Floats]:
        """Return the energy that each model predicts of rides, NaN where it cannot tell. [kWh]"""
        needs = dict.fromkeys(name for standing in self.standings for name in standing.model.needs)
        return self.predict(model_columns(totals, context, tuple(needs)), len(totals.lane))

    def predict(self, columns: Mapping[str, Any] | pd.DataFrame, rows: int) -> list[Floats]:
        """Return the energy that each model predicts from columns of the ride table; NaN where it fails. [kWh]"""
        return [self._tried(standing, columns, rows) for standing in self.standings]

    def power(self, effect: Effect, signals: Signals) -> Floats:
        """Return the power of an effect that only shadows have; NaN, counted, where it fails. [W/unit]"""
        try:
            return np.broadcast_to(effect.power(signals), signals.clean.dt.shape)
        except Exception as fault:  # noqa: BLE001 - what a shadow does must not stop the first
            self.faults[f"effect {effect.name}: {type(fault).__name__}"] += 1
            return np.full(signals.clean.dt.shape, np.nan)

    def add(self, rides: Totals, fit: NDArray[np.bool_], context: RunContext) -> None:
        """Take rides that have ended, of which some are fit for training."""
        measured = measured_energy(rides, context.cars)[0]
        rows = np.flatnonzero(fit & np.isfinite(measured))
        if not len(rows):
            return
        taken = Totals(*(part[rows] for part in rides))  # type: ignore[arg-type]
        kinds = taken.at_last("kind").astype(np.int64).tolist()
        self.count(
            Ended(
                taken.lane,
                taken.at_first("time"),
                taken.at_last("time"),
                [context.cars.name(kind) for kind in kinds],
                measured[rows],
                self.predictions(taken, context),
            )
        )

    def count(self, rides: Ended) -> None:
        """Count rides, in the order in which they ended."""
        days = np.floor(rides.start / SECONDS_PER_DAY).tolist()  # rides that begin on the same UTC day are a cluster
        measured, end = rides.measured.tolist(), rides.end.tolist()
        errors = [(predicted - rides.measured).tolist() for predicted in rides.predicted]
        for i, lane in enumerate(rides.lane.tolist()):
            group = self._group(rides.vehicle_model[i])
            for standing, error in zip(self.standings, errors, strict=True):
                standing.add(lane, days[i], group, error[i], errors[0][i], measured[i])
            self._time = end[i]
            self._tell()

    def close(self) -> None:
        """End the vehicle-days in progress, at the end of the stream."""
        for standing in self.standings:
            standing.close()
        if isfinite(self._time):
            self._tell()

    def errors(self) -> list[ModelErrors]:
        """Return how each model fares by now; its time is NaN before a ride has counted."""
        return [standing.errors(self.standings[0].label, self._time) for standing in self.standings]

    def messages(self, *, newest_only: bool = False) -> list[Message]:
        """Return what has become due since the last call, or of each model the newest."""
        taken, self._due = self._due, []
        if newest_only:
            taken = taken[-len(self.standings) :]
        return [
            Message(f"{self._prefix}models/{model_identity(told.model)}/errors", encode(told), int(told.time_s * 1e9))
            for told in taken
        ]

    def quality(self) -> dict[str, Any]:
        """Return counters: `unpredicted_by_shadow` rides that count, `shadow_faults` by what failed, in batches."""
        counts = {standing.label: standing.unpredicted for standing in self.standings[1:]}
        return {"unpredicted_by_shadow": counts, "shadow_faults": dict(self.faults)}

    def dump(self) -> Any:
        """Return the state as plain lists."""
        standings = {standing.label: standing.dump() for standing in self.standings}
        return [self.standings[0].label, self._time, self._groups, standings, self.faults]

    def load(self, state: Any) -> None:
        """Take up a state that `dump` returned: of the models that it has, if the first is the same."""
        first, self._time, groups, standings, faults = state
        if first != self.standings[0].label:
            self._time = float("nan")
            return
        self._groups, self.faults = groups, Counter(faults)
        for standing in self.standings:
            if standing.label in standings:
                standing.load(standings[standing.label], groups)
            standing.open_groups(groups)

    def _tell(self) -> None:
        """Keep what is to be told."""
        if self._keep:
            self._due += self.errors()

    def _check(self) -> None:
        """Refuse two models that would be published under one key."""
        seen: set[str] = set()
        for standing in self.standings:
            key = model_identity(standing.label)
            if key in seen:
                raise ModelError(
                    f"model {standing.label} is given twice: leave one out, or fit one anew, so that name or version "
                    "differ"
                )
            seen.add(key)

    def _group(self, name: str | None) -> int | None:
        """Return the place of a vehicle model among those with running errors of their own."""
        if name is None:
            return None
        if name not in self._groups:
            if len(self._groups) >= MOST_VEHICLE_MODELS:
                return None
            self._groups.append(name)
            for standing in self.standings:
                standing.open_groups(self._groups)
        return self._groups.index(name)

    def _tried(self, standing: Standing, columns: Mapping[str, Any] | pd.DataFrame, rows: int) -> Floats:
        """Return what a model predicts; NaN, counted, where it fails."""
        try:
            return standing.model.predict(columns)
        except Exception as fault:  # noqa: BLE001 - what a shadow does must not stop the first
            self.faults[f"model {standing.label}: {type(fault).__name__}"] += 1
            return np.full(rows, np.nan)
