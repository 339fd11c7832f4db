"""The one list of steps, from messages to forecasts and totals: live, replay, training and tests all run it."""

from collections import Counter
from collections.abc import Sequence
from operator import itemgetter
from typing import Any, Final, NamedTuple

import numpy as np
import pandas as pd

from core import effects
from core.batch import Batch, Ints, Lanes, grown
from core.cleaning.kernel import STATE, Cleaner
from core.cleaning.quality import CAUSES
from core.errors import AskError
from core.forecast.day_rollover import Calendar, Night
from core.forecast.engine import Foresight, Rows
from core.forecast.gathered import Gathered, joined
from core.forecast.messages import forecasts
from core.forecast.plan_checks import older, refusal
from core.forecast.plan_tracker import Arrival, Driving
from core.forecast.soc_filter import BETWEEN_SHIFTS
from core.forecast.status import VehicleStatus, statuses
from core.forecast.tables import Told, outlook_table, shift_table
from core.forecast.what_if import answer, silenced
from core.models import EXTENDED_PHYSICAL, Model
from core.monitoring.shadow import Shadows
from core.settings import Settings, checked
from core.signals.signals import Signals, ambient_quality
from core.signals.weather import Stations
from core.snapshot import opened, sealed
from core.totals.accumulator import Ledger, Sums, Totals, amounts
from core.totals.context import RunContext
from core.totals.tables import ride_table, text, unfit_reason, window_table
from core.vehicles.fleet import Cars
from core.wire.decoder import Decoder, Event
from core.wire.messages import Leg, Message, Outlook, Plan, Ride, Vehicle, Weather

BLOCK: Final = 4000
"""Rows that go through the steps at a time, so that their columns stay in the cache.

No power of two: columns that lie a multiple of 4 KiB apart would push each other out of it, and the kernel would take
twice the time.
"""
DRIVERS: Final = 10_000
"""Rides whose driver is remembered, beside eight a vehicle."""


class Due(NamedTuple):
    """Forecasts that have become due: running totals, and what is told at them."""

    totals: Totals
    rows: Rows


class Closed(NamedTuple):
    """Rides that have ended, and their names."""

    totals: Totals
    names: list[str | None]


class Pipeline:
    """Everything between the codec and the forecast, with the state of every vehicle.

    Parameters
    ----------
    model : Model
        Makes the predictions.
    settings : Settings
    prefix : str
        Chunks before `fleet` in the keys of forecasts, and before `models`, with a slash at the end.
    shadows : sequence of Model
        Run beside it on the same sums; how each fares is what `model_errors` returns. What fails in them is counted.
    also : sequence of str
        Effects to sum beside those of the model, for tables that other models will be fitted to.
    keep_forecasts : bool
        Keep what forecasts are made of, and how models fare, until asked for. Who wants tables only says False.
    keep_tables : bool
        Keep totals of rides and windows until they are taken. A consumer that never takes them says False.
    keep_outlooks : bool
        Keep every forecast of the charge, and every shift, until they are taken.

    Raises
    ------
    SettingsError
        For a setting outside its limits.
    ModelError
        Where two models have the same name and version.
    """

    def __init__(
        self,
        model: Model = EXTENDED_PHYSICAL,
        settings: Settings = Settings(),  # noqa: B008 - immutable
        prefix: str = "",
        *,
        shadows: Sequence[Model] = (),
        also: Sequence[str] = (),
        keep_forecasts: bool = True,
        keep_tables: bool = True,
        keep_outlooks: bool = False,
    ) -> None:
        self.prefix = prefix
        self.keep_forecasts = keep_forecasts
        self.keep_tables = keep_tables
        self.keep_outlooks = keep_outlooks
        self.settings = checked(settings)
        self.lanes = Lanes()
        self.decoder = Decoder(self.lanes)
        self.cleaner = Cleaner(self.settings)
        self.stations = Stations()
        self.cars = Cars()
        self.shadows = Shadows([model, *shadows], prefix, keep=keep_forecasts)
        served = dict.fromkeys((*model.effects, *also))
        beside = dict.fromkeys(name for shadow in shadows for name in shadow.effects)
        self.effects = [effects.get(name) for name in served | beside]
        self._served = len(served)
        self.ledger = Ledger(len(self.effects))
        self.context = RunContext(self.lanes, self.cars, [effect.name for effect in self.effects], self.settings, model)
        self.foresight = Foresight(self.context, self.ledger.width)
        self._gathered = Gathered(self.ledger.none())
        self._drivers: dict[str, str] = {}
        self._planned: dict[int, float] = {}
        self._quality = np.zeros(len(CAUSES), np.int64)
        self._due: list[Due] = []
        self._told: list[Told] = []
        self.calendar = Calendar()
        self._rides: list[Closed] = []
        self._windows: list[Totals] = []
        self._unfit: Counter[str] = Counter()
        self._unpredicted: Counter[str] = Counter()
        self._ended = 0

    def push(self, messages: Sequence[Message]) -> list[Message]:
        """Take messages in the order of their arrival; return the forecasts that have become due, in that order."""
        self.take(messages)
        return self.forecasts()

    def take(self, messages: Sequence[Message]) -> None:
        """Take messages in the order of their arrival; `forecasts` then has what has become due.

        Which samples call for a forecast is a matter of event time alone, so that the same messages give the same
        forecasts, to the bit, however they are cut into batches.
        """
        self._forget_rides()
        batch, events = self.decoder.decode(messages)
        if self.keep_forecasts:
            nights = [Event(row, -1, Night()) for row in self.calendar.nights(batch.lane, batch.stamp)]
            events = sorted([*events, *nights], key=itemgetter(0)) if nights else events
        start = 0
        told: list[tuple[int, int, Vehicle]] = []
        for row, lane, value in events:
            if isinstance(value, Vehicle):
                if self._met(lane, batch.lane[:row]) and (told or not self.cars.is_one(lane, value)):
                    self._advance(batch, start, row, told)
                    self._foresee(row)
                    start, told = row, []
                told.append((row - start, lane, value))
            elif isinstance(value, Ride | Plan):
                self._say(row, lane, value)
            elif isinstance(value, Weather | Night):  # it changes what every later row meets
                self._advance(batch, start, row, told)
                start, told = row, []
                self._turn(value, row)
        self._advance(batch, start, batch.size, told)
        if self._gathered.size >= BLOCK:
            self._foresee(batch.size)
        self._gathered.end(batch.size)

    def _met(self, lane: int, before: Ints) -> bool:
        """Tell whether anything that matters to forecasts was heard of a car, or said, also in this batch."""
        if not self.keep_forecasts:
            return False
        heard = lane < len(self.cleaner.state) and self.cleaner.state["samples"][lane] > 0.0
        planned = lane in self._gathered.lanes or lane in self.foresight.courses.plans
        return bool(heard or planned or (before == lane).any())

    def _turn(self, value: Weather | Night, row: int) -> None:
        """Take an observation of the weather, or a night, before a row."""
        if isinstance(value, Night):
            self._foresee(row)
            self.foresight.overnight()
        elif not self.stations.observe(value):
            self.decoder.refuse("weather", "out_of_range")

    def _say(self, at: int, lane: int, value: Ride | Plan) -> None:
        """Take what dispatch says of a car before a row, if it can be used."""
        if isinstance(value, Ride):
            self._drive(value)
            if self.keep_forecasts and value.driver_id and value.event == "start":
                self._gathered.say(Driving(at, lane, value.driver_id))
        elif older(value, self._planned.get(lane, value.time_s)):
            self.decoder.refuse("plan", "plan_in_the_past")
        elif (refused := refusal(value, value.time_s)) is not None:
            self.decoder.refuse("plan", refused.cause)
        elif self.keep_forecasts:
            self._planned[lane] = value.time_s
            self._gathered.say(Arrival(at, lane, value))

    def forecasts(self, *, newest_only: bool = False) -> list[Message]:
        """Return the forecasts that have become due since the last call.

        Parameters
        ----------
        newest_only : bool
            Of several forecasts of a vehicle, return the last one: what is of use to whoever listens live.
        """
        self._foresee()
        taken, self._due = self._due, []
        if not taken:
            return []
        due = joined([each.totals for each in taken], self.ledger.none())
        rows = Rows.joined([each.rows for each in taken])
        if newest_only:
            last = due.newest()
            due, rows = due.rows(last), rows.rows(last)
        return forecasts(due, rows, self._ride_names(due), self.context, self.prefix)

    def model_errors(self, *, newest_only: bool = False) -> list[Message]:
        """Return how each model fares, where there are shadows: after each ride that ended since the last call.

        Parameters
        ----------
        newest_only : bool
            After the last of them only.
        """
        return self.shadows.messages(newest_only=newest_only)

    def finish(self) -> list[Message]:
        """Close every ride and window in progress, at the end of the stream; `model_errors` has how models fared."""
        self._foresee()
        sums = self.ledger.close()
        self._keep(sums)
        if self.keep_forecasts:
            self.foresight.follow(sums, [], [])
            self.foresight.finish()
        if self.shadows:
            self.shadows.close()
        return []

    def learn_from(self, earlier: "Pipeline") -> None:
        """Take up the cars that another pipeline knows and what it has learned of them, not what it was amid.

        Call it before the first message, with one that sums the same effects in the same order.
        """
        earlier._foresee()  # noqa: SLF001 - another of this class
        self.lanes.load(earlier.lanes.names)
        self.cars.load(earlier.cars.dump())
        self.cars.unpredictable.clear()
        self.foresight.learn_from(earlier.foresight)

    def take_rides(self) -> pd.DataFrame:
        """Return the rides that have ended since the last call, as `core.totals.tables.ride_table` has them."""
        taken, self._rides = self._rides, []
        totals = joined([closed.totals for closed in taken], self.ledger.none())
        ride_names = [name for closed in taken for name in closed.names]
        table = ride_table(totals, ride_names, self.context)
        rides = zip(table["vehicle_id"], ride_names, strict=True)
        table.insert(4, "driver_id", text([self._drivers.get(f"{vehicle}/{name}") for vehicle, name in rides]))
        return table

    def take_windows(self) -> pd.DataFrame:
        """Return the windows that have ended since the last call, as `core.totals.tables.window_table` has them."""
        taken, self._windows = self._windows, []
        return window_table(joined(taken, self.ledger.none()), self.context)

    def take_outlooks(self) -> pd.DataFrame:
        """Return the forecasts of the charge since the last call, see `core.forecast.tables.outlook_table`."""
        self._foresee()
        taken, self._told = self._told, []
        return outlook_table(taken, self.context)

    def take_shifts(self) -> pd.DataFrame:
        """Return the shifts that have ended since the last call, as `core.forecast.tables.shift_table` has them."""
        self._foresee()
        return shift_table(self.foresight.take_shifts(), self.context)

    def ask(self, vehicle_id: str, leg: Leg | None = None, plan: Plan | None = None) -> Outlook:
        """Return what is expected of the rest of a vehicle's shift; nothing, where that ended in silence meanwhile.

        Parameters
        ----------
        vehicle_id : str
        leg : Leg, optional
            A ride that is asked for, to be driven before the rest of the plan.
        plan : Plan, optional
            To be answered instead of the one that is known; it is not kept.

        Raises
        ------
        AskError
            For a vehicle that has sent nothing, or a plan that cannot be used.
        """
        self._foresee()
        lane = self.lanes.find(vehicle_id)
        if lane is None or lane >= len(self.foresight.state) or not self.foresight.state["heard"][lane]:
            raise AskError(f"vehicle {vehicle_id!r} has sent nothing so far: give one that has", "unknown_vehicle")
        told = answer(self.foresight, lane, leg, plan)
        silent = self.calendar.silence(lane)
        return silenced(told, silent) if silent > BETWEEN_SHIFTS else told

    def quality(self) -> dict[str, Any]:
        """Return the counters since the start.

        Keys: `received` by kind, `undecodable` by cause, `samples` by quality bit, `rides` ended, `unfit` rides by
        reason, `unpredicted` rides by reason, `vehicles`, `unpredictable` vehicle messages by reason; and of shadows
        `unpredicted_by_shadow` rides that count, `shadow_faults` by what failed.
        """
        counts = {
            "vehicles": len(self.lanes),
            "received": dict(self.decoder.received),
            "undecodable": dict(self.decoder.rejected),
            "samples": dict(zip(CAUSES, self._quality.tolist(), strict=True)),
            "rides": self._ended,
            "unfit": dict(self._unfit),
            "unpredicted": dict(self._unpredicted),
            "unpredictable": dict(self.cars.unpredictable),
        }
        return counts | self.shadows.quality() if self.shadows else counts

    def status(self) -> list[VehicleStatus]:
        """Return the newest of every vehicle that has sent a sample."""
        self._foresee()
        lanes = np.flatnonzero(self.cleaner.state["samples"][: len(self.lanes)] > 0.0)
        totals = self.ledger.running(lanes)
        predicted = self.shadows.predictions(totals, self.context)
        ends = grown(self.foresight.ends, len(self.lanes), np.nan)[lanes]
        return statuses(totals, self._ride_names(totals), self.context, predicted, ends)

    def snapshot(self) -> bytes:
        """Return the state of every vehicle, from which `restore` goes on as if nothing had happened.

        Rides and windows that have ended but were not taken are not part of it: take them first.
        """
        self._foresee()
        state = {
            "model": self.context.model_label,
            "effects": self.context.effects,
            "lanes": self.lanes.names,
            "cleaner": self.cleaner.state.tobytes(),
            "ledger": self.ledger.books.tobytes(),
            "rides": list(self.decoder.rides.name_of.items()),
            "opened": self.decoder.rides.opened,
            "stations": self.stations.dump(),
            "cars": self.cars.dump(),
            "foresight": self.foresight.dump(),
            "calendar": self.calendar.dump(),
            "drivers": self._drivers,
            "planned": list(self._planned.items()),
            "counters": [
                self._quality.tolist(),
                self._ended,
                self._unfit,
                self._unpredicted,
                self.decoder.received,
                self.decoder.rejected,
            ],
            "shadows": self.shadows.dump() if self.shadows else None,
        }
        return sealed(state)

    def restore(self, snapshot: bytes) -> None:
        """Take up a state that `snapshot` returned.

        Running errors go on of the models that are still there, if the first is the same; else they begin anew.

        Raises
        ------
        SocastError
            Where it is no snapshot, or one of another version or list of effects.
        """
        state = opened(snapshot, list(self.context.effects))
        self.lanes.load(state["lanes"])
        self.decoder = Decoder(self.lanes)
        self.decoder.rides.update({name: code for code, name in state["rides"]})
        self.decoder.rides.name_of = dict(state["rides"])
        self.decoder.rides.opened = state["opened"]
        self.cleaner.state = np.frombuffer(state["cleaner"], STATE).copy()
        width = self.ledger.books.shape[1]
        self.ledger.books = np.frombuffer(state["ledger"]).reshape(-1, width).copy()
        self.stations.load(state["stations"])
        self.cars.load(state["cars"])
        self.foresight.load(state["foresight"])
        self.calendar.load(state["calendar"])
        self._drivers = state["drivers"]
        self._planned = {int(lane): time for lane, time in state["planned"]}
        quality, self._ended, unfit, unpredicted, received, rejected = state["counters"]
        self._quality = np.array(quality, np.int64)
        self._unfit, self._unpredicted = Counter(unfit), Counter(unpredicted)
        self.decoder.received, self.decoder.rejected = Counter(received), Counter(rejected)
        if self.shadows and state["shadows"] is not None:
            self.shadows.load(state["shadows"])

    @property
    def model(self) -> Model:
        """Makes the published predictions."""
        return self.context.model

    def _advance(self, batch: Batch, start: int, stop: int, told: list[tuple[int, int, Vehicle]]) -> None:
        """Take the rows between two observations of the weather through the steps, a block at a time."""
        kind = self.cars.kinds(batch.lane[start:stop], told, len(self.lanes))
        for at in range(start, stop, BLOCK):
            end = min(at + BLOCK, stop)
            sums = self.sum_up(batch.rows(at, end), kind[at - start : end - start])
            self._keep(sums)
            if self.keep_forecasts:
                self._gathered.add(sums, at, end - at)
                if self._gathered.size >= BLOCK:
                    self._foresee(end)

    def _foresee(self, end: int = 0) -> None:
        """Take what became of the rows up to `end` into account of what is ahead; between batches, of all."""
        if not self._gathered:
            return
        sums, plans, drivers = self._gathered.take(end)
        rows = self.foresight.follow(sums, plans, drivers)
        if len(sums.running.lane):
            self._due.append(Due(sums.running, rows))
            if self.keep_outlooks:
                self._told.append(Told.of(sums.running, rows))
        if not self.keep_outlooks:
            self.foresight.take_shifts()

    def sum_up(self, batch: Batch, kind: Any) -> Sums:
        """Run the steps from samples to sums: clean, weather, signals, effects, sums; `kind` is that of each car."""
        lanes = len(self.lanes)
        clean = self.cleaner.clean(batch, lanes)
        sky = self.stations.sky(clean.time, clean.latitude, clean.longitude)
        clean = clean._replace(quality=ambient_quality(clean, sky))
        mass, rolling_resistance, drag_area, _, scale = self.cars.parameters.take(kind, axis=0).T
        signals = Signals(clean, sky, mass, scale, rolling_resistance, drag_area)
        with np.errstate(all="ignore"):  # a user's effect may divide by a speed that it then masks
            powers = [(effect.per, effect.power(signals)) for effect in self.effects[: self._served]]
            powers += [(effect.per, self.shadows.power(effect, signals)) for effect in self.effects[self._served :]]
        for place in range(len(CAUSES)):
            self._quality[place] += np.count_nonzero(clean.quality & (1 << place))
        return self.ledger.add(clean, kind, amounts(signals, powers), lanes)

    def _drive(self, ride: Ride) -> None:
        """Remember who drives; the oldest rides are forgotten."""
        if ride.driver_id is not None:
            self._drivers[f"{ride.vehicle_id}/{ride.ride_id}"] = ride.driver_id
            if len(self._drivers) > 8 * len(self.lanes) + DRIVERS:
                del self._drivers[next(iter(self._drivers))]

    def _keep(self, sums: Sums) -> None:
        """Count the rides that have ended, and keep them until they are taken."""
        rides = sums.rides
        if not len(rides.lane):
            if self.keep_tables and len(sums.windows.lane):
                self._windows.append(_owned(sums.windows))
            return
        self._ended += len(rides.lane)
        reasons = unfit_reason(rides, self.context)
        kinds = rides.at_last("kind").astype(np.int64).tolist()
        self._unpredicted.update(why for why in map(self.cars.unpredicted, kinds) if why is not None)
        self._unfit.update(reason for reason in reasons.tolist() if reason is not None)
        names = self._ride_names(rides)
        if self.shadows:
            fit = np.array([reason is None for reason in reasons])
            self.shadows.add(rides, fit, self.context)
        if self.keep_tables:
            self._rides.append(Closed(_owned(rides), names))
            self._windows.append(_owned(sums.windows))

    def _forget_rides(self) -> None:
        """Forget the names of rides that have ended, once there are many."""
        if len(self.decoder.rides) > 2 * len(self.lanes) + 10_000:
            self._foresee()
            held = [due.totals.at_last("code") for due in self._due]
            self.decoder.rides.keep(set(np.concatenate([self.cleaner.state["code"], *held]).tolist()))

    def _ride_names(self, totals: Totals) -> list[str | None]:
        """Return the names that loggers gave to rides."""
        name_of = self.decoder.rides.name_of
        return [name_of.get(code) for code in totals.at_last("code").tolist()]


def _owned(totals: Totals) -> Totals:
    """Return a copy that does not keep a whole block's memory alive."""
    return Totals(*(np.array(part) for part in totals))  # type: ignore[arg-type]
