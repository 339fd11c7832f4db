"""Run all steps from messages to forecasts and totals, the same for live operation, replay, training and tests."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pandas as pd

from socast.core.batch import Batch, Lanes, OfLanes, Stateful
from socast.core.cleaning.elevation_map import ElevationMap
from socast.core.columns import SECONDS_PER_DAY
from socast.core.errors import SettingsError
from socast.core.forecast.day_rollover import DayRollover
from socast.core.forecast.due_forecasts import DueForecasts
from socast.core.forecast.engine import ForecastEngine
from socast.core.forecast.event_intake import EventIntake, NewestPlans
from socast.core.forecast.silent_cars import RestOfBatch, SilentCars
from socast.core.forecast.status import VehicleStatus, build_statuses
from socast.core.models import EXTENDED_PHYSICAL, Model
from socast.core.monitoring.shadow import ShadowModels
from socast.core.settings import Limits, Settings, check_limits, checked
from socast.core.snapshot import SCHEMAS, describe_model_change, load_components, open_snapshot, seal_snapshot
from socast.core.totals.context import RunContext
from socast.core.totals.sample_totals import SampleTotals
from socast.core.vehicles.fleet import Cars
from socast.core.wire.decoder import Decoder, Event, Refused
from socast.core.wire.duplicate_filter import DuplicateFilter
from socast.core.wire.message_order import MessageOrder
from socast.core.wire.messages import Leg, Message, Outlook, Plan


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
        Models that run beside it on the same totals. Their faults are counted and never stop the run.
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
        self.settings, self.model, self.model_change = checked(settings), model, ""
        self.limits, self.lanes, self.cars = check_limits(limits), Lanes(), Cars(limits)
        self.shadows = ShadowModels([model, *shadows], prefix, keep=keep_forecasts)
        effects, powers = self.shadows.list_effects(also)
        self.context = context = RunContext(self.lanes, self.cars, effects, self.settings, model)
        self.decoder, self.plans, self.silent_cars = Decoder(self.lanes, limits), NewestPlans(), SilentCars()
        self.duplicates, self.day_rollover = DuplicateFilter(self.lanes, limits, self.decoder.batches), DayRollover()
        names = self.decoder.rides
        self.totals = SampleTotals(context, powers, names, limits, elevation_map, two_sided=two_sided, keep=keep_tables)
        none = self.totals.accumulator.none()
        self.engine = ForecastEngine(context)
        self.due = DueForecasts(self.engine, none, names, prefix, keep=keep_forecasts, keep_outlooks=keep_outlooks)
        self._intake = EventIntake(context, self.decoder, self.silent_cars, self.plans, self.totals, self.due)

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
        while messages:
            new, messages = self.duplicates.select_new(messages)
            if again := self.duplicates.forget(self._use(new, record)):
                self._use(again, record)

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
        for piece, rest in self._intake.cut(batch, events, order, refusals):
            for block, sums in self.totals.add(batch, piece, order):
                self.shadows.add(sums.rides, self.context)
                self.due.add(sums, len(block), order.of_row(block.stop))
            if rest is not None:
                self._begin_day(rest)
        self.due.end_batch(order.size)
        self.totals.end_batch(order.size)

    def _begin_day(self, rest: RestOfBatch) -> None:
        """Let what was learned of the day take effect, and forget what has been silent for days."""
        place, since = rest.order.of_event(rest.first - 1), rest.midnight - self.limits.silent_days * SECONDS_PER_DAY
        self.due.update(place)
        self.totals.begin_day(place, since)
        self.engine.apply_daily_update(rest.midnight - SECONDS_PER_DAY)
        kept = self.silent_cars.begin_day(rest.midnight, since, self.totals.closed.get_lanes())
        if kept is not None and not self.due.keep_outlooks and self.totals.deferred is None:
            self.due.build_all()
            rest.forget_lanes(kept, self.lanes, self.day_rollover, self._get_parts_of_lanes())

    def _forget_ride_names(self) -> None:
        """Forget the names of rides that have ended, once there are many."""
        if self.decoder.rides.are_many(len(self.lanes)):
            used = np.concatenate([*self.due.get_ride_codes(), *self.totals.get_ride_codes()])
            self.decoder.rides.keep(set(used.tolist()))

    def finish(self) -> list[Message]:
        """Close all rides, windows and running errors in progress at the end of the stream, and return no messages."""
        self.due.update()
        for sums in self.totals.finish():
            self.shadows.add(sums.rides, self.context)
            self.due.add(sums, 0, 0)
        self.due.finish()
        self.shadows.close()
        return []

    def forecasts(self, *, newest_only: bool = False) -> list[Message]:
        """Return the forecasts since the last call, in the order in which they became due.

        With `newest_only` only the last of several forecasts of a vehicle is returned, for a live consumer.
        """
        return self.due.take(newest_only=newest_only)

    def model_errors(self, *, newest_only: bool = False) -> list[Message]:
        """Return the running errors of all models after each ride, or the last one, that ended since the last call."""
        return self.shadows.messages(newest_only=newest_only)

    def take_rides(self) -> pd.DataFrame:
        """Return the rides that have ended since the last call, see `socast.core.totals.tables.tabulate_rides`."""
        return self.totals.take_rides()

    def take_windows(self) -> pd.DataFrame:
        """Return the windows that have ended since the last call, see `socast.core.totals.tables.tabulate_windows`."""
        return self.totals.take_windows()

    def take_outlooks(self) -> pd.DataFrame:
        """Return the forecasts of the charge since the last call, see `socast.core.forecast.tables`."""
        return self.due.take_outlooks()

    def take_shifts(self) -> pd.DataFrame:
        """Return the shifts that have ended since the last call, see `socast.core.forecast.tables.tabulate_shifts`."""
        return self.due.take_shifts()

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
        return self.due.ask(vehicle_id, self.totals.cleaner.lanes_heard(), self.day_rollover, leg, plan)

    def quality(self) -> dict[str, Any]:
        """Return the counters since the start.

        Keys: `received` by kind, `duplicates` dropped, `lost` samples, `implausible_forecasts` withheld by cause,
        `undecodable` by cause, `samples` by quality bit, `rides` ended, rides `unfit` and `unpredicted` by reason,
        `vehicles`, `unpredictable` vehicle messages by reason, and vehicles of `unknown_models`. With shadows also
        `unpredicted_by_shadow`, of the rides that count, and `shadow_faults` by cause. With a map also `elevation_map`.
        """
        return {
            "vehicles": len(self.lanes),
            "received": dict(self.decoder.received),
            "duplicates": self.duplicates.dropped,
            "lost": int(self.decoder.losses.lost().sum()),
            "implausible_forecasts": dict(self.due.implausible),
            "undecodable": dict(self.decoder.rejected),
            **self.totals.counters.describe(),
            "unpredictable": dict(self.cars.unpredictable),
            "unknown_models": self.cars.group_unknown(self.context.vehicle_ids),
            **self.totals.cleaner.map_lookup.count_fixes(),
            **self.shadows.quality(),
        }

    def status(self) -> list[VehicleStatus]:
        """Return the newest values of every vehicle that has sent a sample, by name."""
        self.due.update()
        totals = self.totals.describe_running()
        predicted = self.shadows.predictions(totals, self.context)
        names = self.decoder.rides.names(totals.at_last("code").tolist())
        newest, silence = self.engine.get_newest(totals.lane), self.day_rollover.measure_silence(totals.lane)
        return build_statuses(totals, names, self.context, predicted, newest, silence)

    def learn_from(self, earlier: "Pipeline", serves: Callable[[str], bool] = lambda _: True) -> None:
        """Take over the knowledge of a pipeline that sums the same effects, and the cars that this one serves."""
        earlier.due.update()
        self.lanes.load(earlier.lanes.dump())
        self.cars.load(earlier.cars.dump())
        self.cars.unpredictable.clear()
        self.totals.displays.load(earlier.totals.displays.dump())
        self.engine.learn_from(earlier.engine)
        self.silent_cars.hear(range(len(self.lanes)), samples=False)
        kept = np.array([lane for lane, name in enumerate(self.lanes.names) if serves(name)], np.int64)
        if len(kept) < len(self.lanes):
            for part in (*self._get_parts_of_lanes(), self.lanes):
                part.keep(kept)

    def snapshot(self, note: Any = None) -> bytes:
        """Return the state of every vehicle, from which `restore` continues as if uninterrupted, and a plain note.

        The snapshot does not hold rides and windows that have ended but were not taken: take them first.
        """
        self.due.update()
        state = {name: component.dump() for name, component in self._get_components().items()}
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
        load_components(self._get_components(), content, self.context.effects)
        self.model_change = describe_model_change(content, self.context.model_label, self.context.effects)
        return content.get("note")

    def _get_components(self) -> dict[str, Stateful]:
        """Return every component that has a state, in the order in which they must load."""
        parts = vars(self.totals) | vars(self)
        return {name: parts[name] for name in SCHEMAS if parts.get(name) is not None}

    def _get_parts_of_lanes(self) -> list[OfLanes]:
        """Return every part that has a state of each lane, beside the lanes themselves and the day."""
        return [self.cars, self.decoder, self.plans, self.totals, self.engine, self.silent_cars, self.shadows]
