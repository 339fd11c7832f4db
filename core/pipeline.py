"""Run all steps from messages to forecasts and totals, the same for live operation, replay, training and tests."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, Final

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from socast.core import effects
from socast.core.batch import Batch, Ints, Lanes, Stateful
from socast.core.cleaning.elevation_map import ElevationMap
from socast.core.cleaning.kernel import Cleaner
from socast.core.cleaning.segmentation import NO_RIDE_EVENTS, RIDE_EVENT, SILENCE, UNKNOWN_NAME
from socast.core.columns import JOULES_PER_KWH, SECONDS_PER_DAY
from socast.core.errors import AskError, SettingsError, suggest_names
from socast.core.forecast.day_rollover import DailyUpdate, DayRollover
from socast.core.forecast.due_forecasts import DueForecasts
from socast.core.forecast.engine import DueInput, ForecastEngine, PendingInput
from socast.core.forecast.newest_plans import NewestPlans
from socast.core.forecast.plan_tracker import DriverNamed, PlanArrival
from socast.core.forecast.plausibility import withhold_implausible
from socast.core.forecast.silent_cars import RestOfBatch, SilentCars, forget_lanes
from socast.core.forecast.soc_filter import SHIFT_GAP
from socast.core.forecast.status import VehicleStatus, build_statuses
from socast.core.forecast.tables import PublishedForecasts, tabulate_outlooks, tabulate_shifts
from socast.core.forecast.weather_forecasts import ForecastArrival
from socast.core.forecast.what_if import answer_query, withhold_charge
from socast.core.models import EXTENDED_PHYSICAL, Model
from socast.core.monitoring.shadow import ShadowModels
from socast.core.settings import Limits, Settings, check_limits, checked
from socast.core.signals.signals import flag_ambient
from socast.core.signals.weather import Stations
from socast.core.snapshot import SCHEMAS, describe_model_change, load_components, open_snapshot, seal_snapshot
from socast.core.totals.accumulator import Accumulator, Sums
from socast.core.totals.clean_rows import CleanRows, PowerOfEffect, sum_rows
from socast.core.totals.closed_rides import ClosedTotals
from socast.core.totals.context import RunContext
from socast.core.totals.deferred_rows import CausalRows, DeferredRows
from socast.core.totals.display_yield import DisplayYields
from socast.core.totals.run_counters import RunCounters
from socast.core.totals.tables import tabulate_rides, tabulate_windows, unfit_reason
from socast.core.vehicles.fleet import Cars, ReplacedKind
from socast.core.wire.decoder import Decoder, Event, Refused
from socast.core.wire.duplicate_filter import DuplicateFilter
from socast.core.wire.message_block import MessageBlock
from socast.core.wire.message_order import MessageOrder, Piece, Silence, VehicleChange
from socast.core.wire.messages import Leg, Message, Outlook, Plan, Ride, Vehicle, Weather
from socast.core.wire.rides import RideDrivers

BLOCK: Final = 4000
"""Number of rows that pass through the steps at a time, so that their columns stay in the cache; no power of two, at
which columns would evict each other from the cache and the kernel would take twice the time."""
SEARCHED: Final = 1000
"""Largest number of vehicles among which a misspelled name is looked for."""
OF_LANES: Final = (
    *("cars", "decoder", "plans", "cleaner", "accumulator", "displays", "engine", "silent_cars", "shadows", "closed"),
)
"""Attributes of a pipeline that have a state of each lane, beside the lanes themselves and the day."""


class Pipeline:
    """Run all steps from messages to forecasts and tables, with the state of every vehicle.

    Parameters
    ----------
    model : Model
        Makes the published predictions.
    settings : Settings
        Thresholds of cleaning, forecasting and fitness for training.
    prefix : str
        Chunks before `fleet` in the keys of forecasts, and before `models`, with a slash at the end.
    shadows : sequence of Model
        Models that run beside it on the same totals; `model_errors` returns their running errors. Their faults are
        counted and never stop the run.
    also : sequence of str
        Effects to sum in addition to those of the models, for tables to which other models will be fitted.
    keep_forecasts : bool
        False computes no forecasts and keeps no running errors, for a consumer of tables only.
    keep_tables : bool
        False keeps no totals of rides and windows, for a consumer that never takes tables.
    keep_outlooks : bool
        True keeps every forecast of the state of charge, and every shift, until they are taken.
    two_sided : bool
        True sums a ride only after its end, with its elevation smoothed from both sides; it excludes forecasts.
    elevation_map : ElevationMap, optional
        Corrects the elevation of every car's fixes before the cleaning.
    limits : Limits
        Limits of what is taken in, so that no sender can exhaust memory or time.

    Raises
    ------
    SettingsError
        If a setting or limit is outside its bounds, or `two_sided` is combined with `keep_forecasts`.
    ModelError
        If two models have the same name and version.
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
        two_sided: bool = False,
        elevation_map: ElevationMap | None = None,
        limits: Limits = Limits(),  # noqa: B008 - immutable
    ) -> None:
        if two_sided and keep_forecasts:
            raise SettingsError("two_sided is True, but forecasts are causal; set keep_forecasts=False")
        self.settings, self.prefix, self.model = checked(settings), prefix, model
        self.model_change = ""
        self.keep_forecasts, self.keep_tables, self.keep_outlooks = keep_forecasts, keep_tables, keep_outlooks
        of_model = dict.fromkeys((*model.effects, *also))
        of_shadows = dict.fromkeys(name for shadow in shadows for name in shadow.effects)
        self.effects = [effects.get(name) for name in of_model | of_shadows]
        self.limits, self.lanes, self.cars = check_limits(limits), Lanes(), Cars(limits)
        self.context = RunContext(self.lanes, self.cars, [each.name for each in self.effects], self.settings, model)
        self.decoder, self.drivers, self.plans = Decoder(self.lanes, limits), RideDrivers(), NewestPlans()
        self.duplicates, self.day_rollover = DuplicateFilter(self.lanes, limits, self.decoder.batches), DayRollover()
        self.cleaner = Cleaner(self.settings, elevation_map)
        self.stations, self.silent_cars = Stations(limits.stations), SilentCars()
        self.accumulator = Accumulator(len(self.effects))
        self.deferred = DeferredRows() if two_sided else None
        self.rows = self.deferred or CausalRows()
        self.displays, self.counters = DisplayYields(self.cars), RunCounters()
        self.closed = ClosedTotals(self.accumulator.none())
        self.shadows = ShadowModels([model, *shadows], prefix, keep=keep_forecasts)
        first, rest = self.effects[: len(of_model)], self.effects[len(of_model) :]  # effects of shadows only may fail
        self._powers: list[PowerOfEffect] = [(effect.per, effect.power) for effect in first]
        self._powers += [(effect.per, partial(self.shadows.power, effect)) for effect in rest]
        self.engine = ForecastEngine(self.context, self.accumulator.width)
        self._pending, self._published = PendingInput(self.accumulator.none()), list[PublishedForecasts]()
        self._due = DueForecasts(self.accumulator.none(), self.context, self.decoder.rides, prefix)

    def push(self, messages: Sequence[Message]) -> list[Message]:
        """Take messages, and return the forecasts that have become due: `take` and then `forecasts`."""
        self.take(messages)
        return self.forecasts()

    def take(self, messages: Sequence[Message], record: Callable[[Sequence[Message]], None] | None = None) -> None:
        """Take messages in the order of their arrival, without returning forecasts.

        Messages that were taken in before are dropped. Event time alone decides which samples call for a forecast, so
        the same messages give the same forecasts, to the bit, however they are cut into batches.

        Parameters
        ----------
        messages : sequence of Message
            Messages in the order of their arrival.
        record : callable, optional
            Function that receives the messages that are new, before anything else uses them.
        """
        messages = MessageBlock.of(messages)
        while messages:
            new, count = self.duplicates.select_new(messages)
            if again := self.duplicates.forget(self._use(new, record)):
                self._use(again, record)
            messages = messages[count:]

    def _use(self, messages: Sequence[Message], record: Callable[[Sequence[Message]], None] | None) -> list[Refused]:
        """Record new messages and run all steps on them; return which of them are refused."""
        if record is not None:
            record(messages)
        self._forget_ride_names()
        batch, events = self.decoder.decode(messages, refusals := list[Refused]())
        events = self.day_rollover.add_updates(batch, events)
        self._process(batch, events, MessageOrder(batch.size, events), refusals)
        return refusals

    def _process(self, batch: Batch, events: list[Event], order: MessageOrder, refusals: list[Refused]) -> None:
        """Run all steps on decoded messages, in their order."""
        piece = Piece(0, [], [], [])
        for number, event in enumerate(events):
            (row, lane, value, _, _), place = event, order.of_event(number)
            self.silent_cars.hear([lane] if lane >= 0 else [], samples=False)
            if isinstance(value, Vehicle):
                piece.changes.append(VehicleChange(row - piece.start, lane, value, place))
            elif isinstance(value, Ride):
                piece.ride_events.append((row, lane, place, *self._take_ride(place, lane, value)))
            elif isinstance(value, Silence):
                piece.ride_events.append((row, lane, place, *SILENCE))
            elif isinstance(value, Plan):
                self._take_plan(place, lane, value)
            elif isinstance(value, Weather):
                self._take_weather(place, event, value, piece, refusals)
            elif isinstance(value, DailyUpdate):  # it applies to every later row
                piece = self._advance(batch, order, piece, row)
                self._take_daily_update(place, value.midnight, RestOfBatch(batch, row, events, number + 1, order))
        self._advance(batch, order, piece, batch.size)
        if self._pending.is_full:
            self._update_forecasts(order.size)
        self._pending.end_batch(order.size)
        self.rows.end_batch(order.size)
        if not self.rows.waits:
            self.drivers.settle()

    def finish(self) -> list[Message]:
        """Close all rides, windows and running errors in progress at the end of the stream, and return no messages."""
        self._update_forecasts()
        self._add_rows(self.rows.close())
        self.drivers.settle()
        self._take_closed(sums := self.displays.attach(self.accumulator.close(), len(self.lanes)))
        if self.keep_forecasts:
            self.engine.process(DueInput(sums))
            self.engine.finish()
        if self.shadows:
            self.shadows.close()
        return []

    def _advance(self, batch: Batch, order: MessageOrder, piece: Piece, stop: int) -> Piece:
        """Run the steps on the rows of a piece, a block at a time; return the empty piece after it."""
        start, ride_events, replaced = piece.start, np.array(piece.ride_events, RIDE_EVENT), list[ReplacedKind]()
        self.silent_cars.hear(batch.lane[start:stop])
        kind = self.cars.kinds(batch.lane[start:stop], piece.changes, len(self.lanes), replaced)
        self.decoder.losses.count(batch.rows(start, stop), self.cars.period.take(kind) != 0.0)
        self._pending.add_replaced(replaced)
        for at in range(start, stop + 1 if stop == start and len(ride_events) else stop, BLOCK):
            end = min(at + BLOCK, stop)
            now = ride_events[: np.searchsorted(ride_events["row"], end, side="right")]
            ride_events = ride_events[len(now) :]
            now["row"] -= at
            seen = [(row - at, value) for row, value in piece.observations if at <= row < end]
            rows = self.clean_up(batch.rows(at, end), kind[at - start : end - start], order.of_rows[at:end], now, seen)
            self._add_rows(self.rows.add(rows))
            if self._pending.is_full:
                self._update_forecasts(order.of_row(end))
        for value in (value for row, value in piece.observations if row == stop):
            self.stations.observe(value)
        return Piece(stop, [], [], [])

    def _add_rows(self, ready: Sequence[CleanRows]) -> None:
        """Sum up cleaned rows, and take the totals, and the daily updates that waited for them."""
        for summed, kind_of_lane in self.rows.sum_up(ready, self.sum_up, BLOCK):
            self._take_closed(sums := self.displays.attach(summed, len(self.lanes)))
            if kind_of_lane is not None:
                self.displays.apply_daily_update(kind_of_lane)
            if self.keep_forecasts:
                self._pending.add_sums(sums, sum(rows.size for rows in ready))

    def clean_up(
        self,
        batch: Batch,
        kind: Ints,
        place: Ints | None = None,
        ride_events: NDArray[np.void] = NO_RIDE_EVENTS,
        observations: Sequence[tuple[int, Weather]] = (),
    ) -> CleanRows:
        """Clean samples and look up their weather.

        Parameters
        ----------
        batch : Batch of n rows
        kind, place : (n,) int
            Kind of car, and place among the messages of the batch; the number of the row without it.
        ride_events : (events,) RIDE_EVENT
        observations : sequence of (row, Weather), each with the row before which it came
        """
        place = np.arange(batch.size) if place is None else place
        of_cars = self.cars.capacity.take(kind) * JOULES_PER_KWH, self.cars.period.take(kind)
        clean, ends = self.cleaner.clean_between(batch, len(self.lanes), place, ride_events, *of_cars)
        sky = self.stations.sky_between(clean.time, clean.latitude, clean.longitude, observations)
        clean = clean._replace(quality=flag_ambient(clean, sky))
        self.counters.count_samples(clean.quality, clean.lane)
        return CleanRows(clean, sky, kind, place, ends)

    def sum_up(self, rows: CleanRows) -> Sums:
        """Run the steps from cleaned rows to totals, see `socast.core.totals.clean_rows.sum_rows`."""
        return sum_rows(rows, self.cars, self._powers, self.accumulator, len(self.lanes))

    def _take_closed(self, sums: Sums) -> None:
        """Count, evaluate and keep the rides and windows that have ended."""
        names, drivers = list[str | None](), list[str | None]()
        if len(sums.rides.lane):
            names = self.decoder.rides.names(sums.rides.at_last("code").tolist())
            drivers = self.drivers.find_all(map(self.lanes.names.__getitem__, sums.rides.lane), names, sums.rides.at)
            reasons = unfit_reason(sums.rides, self.context)
            self.counters.count_rides(sums.rides, reasons, self.context)
            if self.keep_forecasts or self.shadows:
                fit = np.array([reason is None for reason in reasons])
                self.shadows.add(sums.rides, fit, self.context)
        if self.keep_tables:
            self.closed.add(sums, names, drivers)

    def _update_forecasts(self, end: int = 0) -> None:
        """Update filters, plans and forecasts by the messages up to the place `end`; between batches, by all."""
        if not self._pending:
            return
        due = self._pending.take(end)
        rows, running = self.engine.process(due), due.sums.running
        if len(running.lane):
            self._due.add(running, rows)
            if self.keep_outlooks:
                self._published.append(PublishedForecasts.create(running, rows))
        if not self.keep_outlooks:
            self.engine.take_shifts()

    def _take_daily_update(self, place: int, midnight: float, rest: RestOfBatch) -> None:
        """Run the daily update at a place in the batch, and forget what has been silent for days."""
        self._update_forecasts(place)
        self._learn_from_day(place, midnight)
        since = midnight - self.limits.silent_days * SECONDS_PER_DAY
        self.stations.forget_silent(since)
        kept = self.silent_cars.begin_day(midnight, since, self.closed.get_lanes())
        if kept is not None and not self.keep_outlooks and not self.rows.waits:
            self._due.build_all()
            forget_lanes(kept, rest, self.lanes, self.day_rollover, [getattr(self, name) for name in OF_LANES])

    def _learn_from_day(self, place: int, midnight: float) -> None:
        """Let what was learned of the day take effect."""
        for kind_of_lane in self.rows.add_daily_update(place, self.cars.of_lane):
            self.displays.apply_daily_update(kind_of_lane)
        self.engine.apply_daily_update(midnight - SECONDS_PER_DAY)

    def _take_ride(self, place: int, lane: int, ride: Ride) -> tuple[float, float, bool]:
        """Take the driver of a ride; return the code of its name, when it begins or ends, and whether it ends."""
        self.drivers.observe(ride, lane, place + self.rows.messages)
        if self.keep_forecasts and ride.driver_id and ride.event == "start":
            self._pending.add_arrival(DriverNamed(place, lane, ride.driver_id))
        return self.decoder.rides.get(ride.ride_id, UNKNOWN_NAME), ride.time_s, ride.event == "end"

    def _take_plan(self, place: int, lane: int, plan: Plan) -> None:
        """Take a plan, which dispatch sends, or count why it cannot be used."""
        if (cause := self.plans.refuse(lane, plan)) is not None:
            self.decoder.refuse("plan", cause)
        elif self.keep_forecasts:
            self.plans.accept(lane, plan)
            self._pending.add_arrival(PlanArrival(place, lane, plan))

    def _take_weather(self, place: int, event: Event, value: Weather, piece: Piece, refusals: list[Refused]) -> None:
        """Take an observation or a forecast of a station, or refuse it and count why."""
        stations = self.stations if value.issued_s is None else self.engine.weather
        if (cause := stations.admit(value)) is not None:
            self.decoder.refuse("weather", cause)
            refusals.append(Refused(event.message, None, event.number))
        elif value.issued_s is None:
            piece.observations.append((event.row, value))
        elif self.keep_forecasts:
            self._pending.add_arrival(ForecastArrival(place, value))

    def forecasts(self, *, newest_only: bool = False) -> list[Message]:
        """Return the forecasts since the last call, in the order in which they became due.

        With `newest_only` only the last of several forecasts of a vehicle is returned, for a live consumer.
        """
        self._update_forecasts()
        return self._due.take(newest_only=newest_only)

    def model_errors(self, *, newest_only: bool = False) -> list[Message]:
        """Return the running errors of all models after each ride, or the last one, that ended since the last call."""
        return self.shadows.messages(newest_only=newest_only)

    def take_rides(self) -> pd.DataFrame:
        """Return the rides that have ended since the last call, see `socast.core.totals.tables.tabulate_rides`."""
        return tabulate_rides(*self.closed.take_rides(), self.context)

    def take_windows(self) -> pd.DataFrame:
        """Return the windows that have ended since the last call, see `socast.core.totals.tables.tabulate_windows`."""
        return tabulate_windows(self.closed.take_windows(), self.context)

    def take_outlooks(self) -> pd.DataFrame:
        """Return the forecasts of the charge since the last call, see `socast.core.forecast.tables`."""
        self._update_forecasts()
        taken, self._published = self._published, []
        return tabulate_outlooks(taken, self.context)

    def take_shifts(self) -> pd.DataFrame:
        """Return the shifts that have ended since the last call, see `socast.core.forecast.tables.tabulate_shifts`."""
        self._update_forecasts()
        return tabulate_shifts(self.engine.take_shifts(), self.context)

    def ask(self, vehicle_id: str, leg: Leg | None = None, plan: Plan | None = None) -> Outlook:
        """Return the outlook on the rest of a vehicle's shift.

        Parameters
        ----------
        vehicle_id : str
            Name of the vehicle.
        leg : Leg, optional
            Candidate ride, to be driven before the rest of the plan.
        plan : Plan, optional
            Plan to assume instead of the known one; it is not kept.

        Returns
        -------
        Outlook
            It holds no charge where the vehicle has been silent for so long that its shift has ended.

        Raises
        ------
        AskError
            If the vehicle has sent nothing, or the plan cannot be used.
        """
        self._update_forecasts()
        lane = self.lanes.find(vehicle_id)
        if lane is None or not self.engine.has_sample(lane):
            heard = [self.lanes.names[at] for at in self.cleaner.lanes_heard()[:SEARCHED].tolist()]
            remedy = suggest_names(vehicle_id, heard) if heard else "no vehicle has sent anything"
            raise AskError(f"vehicle {vehicle_id!r} has sent nothing so far: {remedy}", "unknown_vehicle")
        outlook = withhold_implausible(answer_query(self.engine, lane, leg, plan), self._due.implausible)
        silent = self.day_rollover.compute_silence(lane)
        return withhold_charge(outlook, silent) if silent > SHIFT_GAP else outlook

    def quality(self) -> dict[str, Any]:
        """Return the counters since the start.

        Keys: `received` by kind, `duplicates` dropped, `lost` samples, `implausible_forecasts` withheld by cause,
        `undecodable` by cause, `samples` by quality bit, `rides` ended, rides `unfit` and `unpredicted` by reason,
        `vehicles`, `unpredictable` vehicle messages by reason, and vehicles of `unknown_models`. With shadows also
        `unpredicted_by_shadow`, of the rides that count, and `shadow_faults` by cause. With a map also `elevation_map`.
        """
        counts = {
            "vehicles": len(self.lanes),
            "received": dict(self.decoder.received),
            "duplicates": self.duplicates.dropped,
            "lost": int(self.decoder.losses.lost().sum()),
            "implausible_forecasts": dict(self._due.implausible),
            "undecodable": dict(self.decoder.rejected),
            **self.counters.describe(),
            "unpredictable": dict(self.cars.unpredictable),
            "unknown_models": self.cars.group_unknown(self.context.vehicle_ids),
        } | self.cleaner.map_lookup.count_fixes()
        return counts | self.shadows.quality() if self.shadows else counts

    def status(self) -> list[VehicleStatus]:
        """Return the newest values of every vehicle that has sent a sample, by name."""
        self._update_forecasts()
        lanes = self.cleaner.lanes_heard()
        totals = self.displays.describe(self.accumulator.running(lanes), len(self.lanes))
        predicted = self.shadows.predictions(totals, self.context)
        names = self.decoder.rides.names(totals.at_last("code").tolist())
        return build_statuses(totals, names, self.context, predicted, self.engine.get_newest(lanes))

    def learn_from(self, earlier: "Pipeline", serves: Callable[[str], bool] = lambda _: True) -> None:
        """Take over the knowledge of a pipeline that sums the same effects, and the cars that this one serves."""
        earlier._update_forecasts()  # noqa: SLF001 - another instance of this class
        self.lanes.load(earlier.lanes.dump())
        self.cars.load(earlier.cars.dump())
        self.cars.unpredictable.clear()
        self.displays.learn_from(earlier.displays)
        self.engine.learn_from(earlier.engine)
        self.silent_cars.hear(range(len(self.lanes)), samples=False)
        kept = np.array([lane for lane, name in enumerate(self.lanes.names) if serves(name)], np.int64)
        if len(kept) < len(self.lanes):
            for component in (*(getattr(self, name) for name in OF_LANES), self.lanes):
                component.keep(kept)

    def snapshot(self, note: Any = None) -> bytes:
        """Return the state of every vehicle, from which `restore` continues as if uninterrupted, and a plain note.

        The snapshot does not hold rides and windows that have ended but were not taken: take them first.
        """
        self._update_forecasts()
        state = {name: component.dump() for name, component in self._components().items()}
        about = {"model": self.context.model_label, "effects": list(self.context.effects)}
        return seal_snapshot(about | {"state": state, "note": note})

    def restore(self, snapshot: bytes) -> Any:
        """Replace the state by one that `snapshot` returned, and return the note that was kept with it.

        If the first model is the same, running errors continue for the models that are present; else they start again.
        `model_change` says what differs. Rides in progress have no prediction where an effect is new.

        Raises
        ------
        SocastError
            If the version or form of the snapshot are others; the pipeline may then only take another state.
        """
        content = open_snapshot(snapshot)
        load_components(self._components(), content, self.context.effects)
        self.model_change = describe_model_change(content, self.context.model_label, self.context.effects)
        return content.get("note")

    def _components(self) -> dict[str, Stateful]:
        """Return every component that has a state, in the order in which they must load."""
        return {name: part for name in SCHEMAS if (part := getattr(self, name, None)) is not None}

    def _forget_ride_names(self) -> None:
        """Forget the names of rides that have ended, once there are many."""
        if self.decoder.rides.are_many(len(self.lanes)):
            self._update_forecasts()
            used = self._due.get_ride_codes()
            if self.rows.waits:  # rides that wait, and rides that the next row of their car will close
                used += [self.rows.ride_codes(), self.accumulator.ride_codes()]
            self.decoder.rides.keep(set(np.concatenate([self.cleaner.ride_codes(), *used]).tolist()))
