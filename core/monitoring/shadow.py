"""Run several models in service side by side, on the same sums, and compare their errors.

The first model makes the published forecasts; the others are its shadows. A new effect of a shadow can thus be verified
in service before it is switched on.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from functools import partial
from itertools import chain
from math import isfinite
from typing import Any, Final, NamedTuple

import numpy as np
import pandas as pd

from socast.core import effects
from socast.core.batch import Floats, Ints
from socast.core.columns import SECONDS_PER_DAY
from socast.core.effects.declaration import Effect
from socast.core.errors import ModelError
from socast.core.forecast.learning.forecast_errors import count_outcomes
from socast.core.models import Model
from socast.core.monitoring.running_error import ModelMonitor
from socast.core.signals.signals import Signals
from socast.core.stats.confidence_sequence import LEVEL
from socast.core.totals.accumulator import Totals
from socast.core.totals.clean_rows import PowerOfEffect
from socast.core.totals.context import RunContext
from socast.core.totals.measured_energy import measure_energy
from socast.core.totals.tables import model_columns, unfit_reason
from socast.core.wire.keys import identify_model
from socast.core.wire.messages import Message, ModelErrors, encode

MOST_VEHICLE_MODELS: Final = 64
"""Number of vehicle models with running errors of their own; rides of later ones count only among all rides."""

INTERVAL_LEVEL: Final = 0.9
"""Probability with which the energy of a ride lies inside the interval of a model."""


class EndedRides(NamedTuple):
    """Hold rides that have ended, are fit for training and have a measured energy.

    Parameters
    ----------
    lane : (n,) int64
    start, end : (n,) float64
        [s]
    measured : (n,) float64
        [kWh]
    predicted : list of (n,) float64
        By each model, NaN where it has no prediction. [kWh]
    """

    lane: Ints
    start: Floats
    end: Floats
    vehicle_model: list[str | None]
    measured: Floats
    predicted: list[Floats]


class ShadowModels:
    """Run the models in service and follow their errors.

    Parameters
    ----------
    prefix : str
        Chunks before `models` in the keys, with a slash at the end.
    keep : bool
        Whether to keep the messages until `messages` returns them.

    Notes
    -----
    Intervals of all shadows hold together: each is made at 1 - 0.05 / shadows. Intervals of one vehicle model hold for
    that vehicle model alone. They apply to the days driven, and do not extrapolate to other seasons.
    """

    def __init__(self, models: Sequence[Model], prefix: str = "", *, keep: bool = True) -> None:
        shadows = len(models) - 1
        level = 1.0 - (1.0 - LEVEL) / max(1, shadows)
        self.prefix, self._keep = prefix, keep
        self.monitors = [ModelMonitor(model, level if place else None) for place, model in enumerate(models)]
        self._check_identities()
        self.faults: Counter[str] = Counter()
        self._time = float("nan")
        self._groups: list[str] = []
        self._due: list[ModelErrors] = []

    def __len__(self) -> int:
        """Return the number of shadows."""
        return len(self.monitors) - 1

    def predictions(self, totals: Totals, context: RunContext) -> list[Floats]:
        """Return the energy of rides by each model.

        Returns
        -------
        list of (n,) float
            NaN where a model has no prediction. [kWh]
        """
        needs = dict.fromkeys(name for monitor in self.monitors for name in monitor.model.needs)
        return self.predict_energy(model_columns(totals, context, tuple(needs)), len(totals.lane))

    def predict_energy(self, columns: Mapping[str, Any] | pd.DataFrame, rows: int) -> list[Floats]:
        """Return the energy by each model from columns of the ride table; NaN where a model fails. [kWh]"""
        return [self._predict_or_count(monitor, columns, rows) for monitor in self.monitors]

    def list_effects(self, also: Sequence[str]) -> tuple[list[str], list[PowerOfEffect]]:
        """Return the names and powers of all effects, those of the first model and others first."""
        first, *rest = (monitor.model.effects for monitor in self.monitors)
        trusted = dict.fromkeys((*first, *also))
        found = [effects.get(name) for name in trusted | dict.fromkeys(chain(*rest))]
        powers = [each.power if i < len(trusted) else partial(self.power, each) for i, each in enumerate(found)]
        return [each.name for each in found], [(each.per, power) for each, power in zip(found, powers, strict=True)]

    def power(self, effect: Effect, signals: Signals) -> Floats:
        """Return the power of an effect that only shadows have; NaN, counted as a fault, where it fails. [W/unit]"""
        try:
            return np.broadcast_to(effect.power(signals), signals.clean.dt.shape)
        except Exception as fault:  # noqa: BLE001 - a fault of a shadow must not stop the first model
            self.faults[f"effect {effect.name}: {type(fault).__name__}"] += 1
            return np.full(signals.clean.dt.shape, np.nan)

    def add(self, rides: Totals, context: RunContext) -> None:
        """Add rides that have ended, if errors are kept or there are shadows."""
        if not len(rides.lane) or not (self._keep or self):
            return
        fit = np.array([reason is None for reason in unfit_reason(rides, context)])
        measured = measure_energy(rides, context.cars).energy
        rows = np.flatnonzero(fit & np.isfinite(measured))
        if not len(rows):
            return
        taken = rides.rows(rows)
        for monitor in self.monitors:
            self._count_interval_outcomes(monitor, taken, context, measured[rows])
        kinds = taken.kinds.tolist()
        self.add_ended(
            EndedRides(
                taken.lane,
                taken.at_first("time"),
                taken.at_last("time"),
                [context.cars.name(kind) for kind in kinds],
                measured[rows],
                self.predictions(taken, context),
            )
        )

    def add_ended(self, rides: EndedRides) -> None:
        """Add rides with their energies, in the order in which they ended."""
        days = np.floor(rides.start / SECONDS_PER_DAY).tolist()  # rides of a vehicle on the same UTC day are a cluster
        measured, end = rides.measured.tolist(), rides.end.tolist()
        errors = [(predicted - rides.measured).tolist() for predicted in rides.predicted]
        for i, lane in enumerate(rides.lane.tolist()):
            group = self._find_group(rides.vehicle_model[i])
            for monitor, error in zip(self.monitors, errors, strict=True):
                monitor.add_ride(lane, days[i], group, error[i], errors[0][i], measured[i])
            self._time = end[i]
            self._keep_messages()

    def close(self) -> None:
        """End the vehicle-days in progress at the end of the stream, if there are shadows."""
        if not self:
            return
        for monitor in self.monitors:
            monitor.close()
        if isfinite(self._time):
            self._keep_messages()

    def errors(self) -> list[ModelErrors]:
        """Return the present errors of each model; their time is NaN before the first ride."""
        return [monitor.get_errors(self.monitors[0].label, self._time) for monitor in self.monitors]

    def messages(self, *, newest_only: bool = False) -> list[Message]:
        """Return the messages that have become due since the last call."""
        taken, self._due = self._due, []
        if newest_only:
            taken = taken[-len(self.monitors) :]
        return [
            Message(
                f"{self.prefix}models/{identify_model(errors.model)}/errors", encode(errors), int(errors.time_s * 1e9)
            )
            for errors in taken
        ]

    def quality(self) -> dict[str, Any]:
        """Return `unpredicted_by_shadow`, of rides by model, and `shadow_faults`, of batches by cause, of shadows."""
        if not self:
            return {}
        counts = {monitor.label: monitor.unpredicted for monitor in self.monitors[1:]}
        return {"unpredicted_by_shadow": counts, "shadow_faults": dict(self.faults)}

    def keep(self, lanes: Ints) -> None:
        """Keep the state of some lanes only, in their order."""
        for monitor in self.monitors:
            monitor.keep(lanes)

    def dump(self) -> Any:
        """Return the state as plain values."""
        monitors = {monitor.label: monitor.dump() for monitor in self.monitors}
        return [self.monitors[0].label, self._time, self._groups, monitors, self.faults]

    def load(self, state: Any) -> None:
        """Replace the state by one that `dump` returned; only of models that it has, and if the first is the same."""
        first, self._time, groups, monitors, faults = state
        if first != self.monitors[0].label:
            self._time = float("nan")
            return
        self._groups, self.faults = groups, Counter(faults)
        for monitor in self.monitors:
            monitor.add_groups(groups)
            if monitor.label in monitors:
                monitor.load(monitors[monitor.label])

    def _keep_messages(self) -> None:
        """Keep the present errors for `messages`; those of a single model are not published."""
        if self._keep and self:
            self._due += self.errors()

    def _check_identities(self) -> None:
        """Refuse two models that would be published under one key."""
        seen: set[str] = set()
        for monitor in self.monitors:
            key = identify_model(monitor.label)
            if key in seen:
                raise ModelError(
                    f"model {monitor.label} is given twice: leave one out, or refit one, so that name or version differ"
                )
            seen.add(key)

    def _find_group(self, name: str | None) -> int | None:
        """Return the index of a vehicle model with running errors of its own; None without them."""
        if name is None:
            return None
        if name not in self._groups:
            if len(self._groups) >= MOST_VEHICLE_MODELS:
                return None
            self._groups.append(name)
            for monitor in self.monitors:
                monitor.add_groups(self._groups)
        return self._groups.index(name)

    def _count_interval_outcomes(
        self, monitor: ModelMonitor, rides: Totals, context: RunContext, measured: Floats
    ) -> None:
        """Count the rides whose measured energy lies inside the interval of a model, if it has one. [kWh]"""
        interval = getattr(monitor.model, "interval", None)
        if interval is None:
            return
        try:
            columns = model_columns(rides, context, (*monitor.model.needs, *interval.needs))
            lower, upper = interval.bounds(monitor.model.predict_energy(columns), columns, INTERVAL_LEVEL)
        except Exception as fault:  # noqa: BLE001 - a fault of a shadow must not stop the first model
            self.faults[f"interval of {monitor.label}: {type(fault).__name__}"] += 1
            return
        monitor.interval_outcomes += count_outcomes(lower, upper, measured)

    def _predict_or_count(self, monitor: ModelMonitor, columns: Mapping[str, Any] | pd.DataFrame, rows: int) -> Floats:
        """Return the energy by a model; NaN, and counted as a fault, where it fails."""
        try:
            return monitor.model.predict_energy(columns)
        except Exception as fault:  # noqa: BLE001 - a fault of a shadow must not stop the first model
            self.faults[f"model {monitor.label}: {type(fault).__name__}"] += 1
            return np.full(rows, np.nan)
