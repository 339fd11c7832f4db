"""Collect input until it pays to compute forecasts, and keep the forecasts until they are taken."""

from collections import Counter
from collections.abc import Sequence
from typing import Final

import numpy as np
import pandas as pd

from socast.core.batch import Floats, Ints
from socast.core.forecast.day_rollover import DayRollover
from socast.core.forecast.engine import DueInput, ForecastEngine
from socast.core.forecast.forecast_rows import Rows, join_rows
from socast.core.forecast.messages import build_forecasts
from socast.core.forecast.plan_tracker import DriverNamed, PlanArrival
from socast.core.forecast.plausibility import withhold_charge, withhold_implausible
from socast.core.forecast.tables import tabulate_outlooks, tabulate_shifts
from socast.core.forecast.weather_forecasts import ForecastArrival
from socast.core.forecast.what_if import answer_query, explain_unknown_vehicle
from socast.core.totals.accumulator import Sums, Totals, join_totals
from socast.core.vehicles.fleet import ReplacedKind
from socast.core.wire.messages import Leg, Message, Outlook, Plan
from socast.core.wire.rides import RideNames

MOST_PENDING: Final = 16_000
"""Number of pending samples and messages from which forecasts are computed; a forecast costs less where many are
computed at once."""


class PendingInput:
    """Collect totals, dispatch messages and weather forecasts until it pays to compute forecasts.

    Batches may be small. Forecasts do not depend on where they are cut, so they are processed together. Messages
    are counted from the first pending batch: `before` is their number before the present one. Without `keep`, for a
    consumer without forecasts, all input is dropped.
    """

    def __init__(self, none: Totals, *, keep: bool = True) -> None:
        self._none, self._nothing, self.keep = none, Sums(none, none, none, none), keep
        self._sums: list[Sums] = []
        self._arrivals: list[PlanArrival | DriverNamed | ForecastArrival] = []
        self._replaced: list[ReplacedKind] = []
        self.size = 0
        self.before = 0

    def __bool__(self) -> bool:
        return bool(self._sums or self._arrivals)

    @property
    def is_full(self) -> bool:
        """Return whether so much is pending that forecasts should be computed."""
        return self.size >= MOST_PENDING

    def add_sums(self, sums: Sums, rows: int) -> None:
        """Add the sums of a number of rows."""
        if not self.keep:
            return
        self._sums.append(Sums(*(totals._replace(at=totals.at + self.before) for totals in sums)))
        self.size += rows

    def add_arrival(self, message: PlanArrival | DriverNamed | ForecastArrival) -> None:
        """Add a plan, the name of a driver or a weather forecast, in the order of their arrival."""
        if not self.keep:
            return
        self._arrivals.append(message._replace(at=self.before + message.at))
        self.size += 1

    def add_replaced(self, kinds: Sequence[ReplacedKind]) -> None:
        """Add the kinds of car that vehicle messages replaced, in the order of their arrival."""
        self._replaced += [each._replace(at=self.before + each.at) for each in kinds]

    def end_batch(self, messages: int) -> None:
        """Mark the end of a batch with a number of messages."""
        self.before = self.before + messages if self else 0
        if not self:
            self._replaced = []

    def take(self, end: int) -> DueInput:
        """Return and drop all sums, joined, and the messages up to the place `end` in the batch."""
        sums, self._sums, self.size = self._sums, [], 0
        due = [each for each in self._arrivals if each.at <= self.before + end]
        self._arrivals = self._arrivals[len(due) :]
        replaced, self._replaced = self._replaced, [each for each in self._replaced if each.at > self.before + end]
        plans = [each for each in due if isinstance(each, PlanArrival)]
        drivers = [each for each in due if isinstance(each, DriverNamed)]
        forecasts = [each for each in due if isinstance(each, ForecastArrival)]
        used = [each._replace(windows=self._none) for each in sums]
        joined = Sums(*(join_totals(parts, self._none) for parts in zip(*used, strict=True))) if used else self._nothing
        return DueInput(joined, plans, drivers, forecasts, replaced)


class DueForecasts:
    """Compute forecasts of pending totals, and keep those that have become due until they are taken.

    Parameters
    ----------
    names : Names of the rides in the totals.
    prefix : Chunks before `fleet` in the keys, with a slash at the end.
    keep : False computes no forecasts.
    keep_outlooks : True keeps the forecasts of the charge, and the shifts, until their tables are taken.

    Attributes
    ----------
    implausible : Number of forecasts and answers that were withheld, by cause.
    """

    def __init__(
        self, engine: ForecastEngine, none: Totals, names: RideNames, prefix: str, *, keep: bool, keep_outlooks: bool
    ) -> None:
        self.implausible: Counter[str] = Counter()
        self.pending, self.keep_outlooks = PendingInput(none, keep=keep), keep_outlooks
        self.engine, self._none, self._names, self._prefix = engine, none, names, prefix
        self._totals: list[Totals] = []
        self._rows, self._outlooks = list[Rows](), list[Rows]()
        self._built: list[Message] = []

    def add(self, sums: Sums, rows: int, place: int) -> None:
        """Add the totals of a number of rows, before a place in the batch."""
        self.pending.add_sums(sums, rows)
        if self.pending.is_full:
            self.update(place)

    def end_batch(self, messages: int) -> None:
        """Note the end of a batch with a number of messages."""
        if self.pending.is_full:
            self.update(messages)
        self.pending.end_batch(messages)

    def update(self, end: int = 0) -> None:
        """Update filters, plans and forecasts by the messages up to the place `end`; between batches, by all."""
        if not self.pending:
            return
        due = self.pending.take(end)
        rows, running = self.engine.process(due), due.sums.running
        if len(running.lane):
            self._totals.append(running)
            self._rows.append(rows)
            if self.keep_outlooks:
                self._outlooks.append(rows)
        if not self.keep_outlooks:
            self.engine.take_shifts()

    def finish(self) -> None:
        """Close every shift in progress at the end of the stream."""
        self.update()
        if self.pending.keep:
            self.engine.finish()

    def get_ride_codes(self) -> list[Floats]:
        """Return the codes of the rides that the forecasts name."""
        self.update()
        return [totals.at_last("code") for totals in self._totals]

    def build_all(self) -> None:
        """Build the messages of all forecasts, before lanes are numbered anew."""
        self._built += self._build(newest_only=False)

    def take(self, *, newest_only: bool) -> list[Message]:
        """Return and drop the forecasts in the order in which they became due, or the last one of each vehicle."""
        self.update()
        built, self._built = self._built, []
        if not built:
            return self._build(newest_only=newest_only)
        built += self._build(newest_only=newest_only)
        return list({message.key: message for message in built}.values()) if newest_only else built

    def ask(
        self, vehicle_id: str, heard: Ints, day_rollover: DayRollover, leg: Leg | None, plan: Plan | None
    ) -> Outlook:
        """Return the outlook of a vehicle, among the lanes that were heard; count and withhold what is implausible."""
        self.update()
        lanes = self.engine.context.lanes
        lane = lanes.find(vehicle_id)
        if lane is None or not self.engine.has_sample(lane):
            raise explain_unknown_vehicle(vehicle_id, map(lanes.names.__getitem__, heard))
        outlook = withhold_implausible(answer_query(self.engine, lane, leg, plan), self.implausible)
        return withhold_charge(outlook, float(day_rollover.measure_silence(np.array([lane]))[0]))

    def take_outlooks(self) -> pd.DataFrame:
        """Return and drop the table of the forecasts of the charge."""
        self.update()
        taken, self._outlooks = self._outlooks, []
        return tabulate_outlooks(taken, self.engine.context)

    def take_shifts(self) -> pd.DataFrame:
        """Return and drop the table of the shifts that have ended."""
        self.update()
        return tabulate_shifts(self.engine.take_shifts(), self.engine.context)

    def _build(self, *, newest_only: bool) -> list[Message]:
        """Return and drop the forecasts whose messages are not built yet."""
        if not self._totals:
            return []
        due, rows = join_totals(self._totals, self._none), join_rows(self._rows)
        self._totals, self._rows = [], []
        if newest_only:
            last = due.newest()
            due, rows = due.rows(last), rows.take(last)
        names = self._names.names(due.at_last("code").tolist())
        return build_forecasts(due, rows, names, self.engine.context, self._prefix, self.implausible)
