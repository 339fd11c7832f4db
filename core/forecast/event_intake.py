"""Pass each message that is no sample to the step that uses it, and cut a batch where the day changes."""

from collections.abc import Iterator
from typing import Any, Final

import numpy as np

from socast.core.batch import Batch, Ints, take_keys
from socast.core.cleaning.segmentation import SILENCE, UNKNOWN_NAME
from socast.core.forecast.day_rollover import DailyUpdate
from socast.core.forecast.due_forecasts import DueForecasts
from socast.core.forecast.plan_tracker import DriverNamed, PlanArrival
from socast.core.forecast.silent_cars import RestOfBatch, SilentCars
from socast.core.forecast.weather_forecasts import ForecastArrival
from socast.core.totals.context import RunContext
from socast.core.totals.sample_totals import SampleTotals
from socast.core.vehicles.fleet import ReplacedKind
from socast.core.wire.decoder import Decoder, Event, Refused
from socast.core.wire.message_order import MessageOrder, Piece, Silence, VehicleChange
from socast.core.wire.messages import Plan, Ride, Vehicle, Weather
from socast.core.wire.plan_checks import find_refusal, is_outdated

_NO_KINDS: Final = np.zeros(0, np.int64)


class NewestPlans:
    """Remember when dispatch made the newest usable plan of each lane; an older plan arrived out of order."""

    def __init__(self) -> None:
        self._made: dict[int, float] = {}

    def refuse(self, lane: int, plan: Plan) -> str | None:
        """Return the cause for which a plan cannot be used, None where it can."""
        if is_outdated(plan, self._made.get(lane, plan.time_s)):
            return "plan_in_the_past"
        refused = find_refusal(plan, plan.time_s)
        return None if refused is None else refused.cause

    def accept(self, lane: int, plan: Plan) -> None:
        """Remember a usable plan as the newest of its lane."""
        self._made[lane] = plan.time_s

    def keep(self, lanes: Ints) -> None:
        """Keep the state of some lanes only, in their order."""
        self._made = take_keys(self._made, lanes)

    def dump(self) -> Any:
        """Return the state as plain values."""
        return list(self._made.items())

    def load(self, state: Any) -> None:
        """Replace the state by one that `dump` returned."""
        self._made = {int(lane): time for lane, time in state}


class EventIntake:
    """Take the messages between the rows of a batch: of vehicles, rides, plans, weather and silences."""

    def __init__(
        self,
        context: RunContext,
        decoder: Decoder,
        silent_cars: SilentCars,
        plans: NewestPlans,
        totals: SampleTotals,
        due: DueForecasts,
    ) -> None:
        self._context, self._decoder, self._silent_cars, self._plans = context, decoder, silent_cars, plans
        self._totals, self._weather, self._pending = totals, due.engine.weather, due.pending

    def cut(
        self, batch: Batch, events: list[Event], order: MessageOrder, refusals: list[Refused]
    ) -> Iterator[tuple[Piece, RestOfBatch | None]]:
        """Take the messages of a batch; yield its rows in pieces, each up to a daily update or to the end.

        A daily update applies to every later row: run it before you ask for the next piece.
        """
        piece, heard = Piece(0, 0, _NO_KINDS, [], [], []), list[int]()
        for number, event in enumerate(events):
            (row, lane, value, _, _), place = event, order.of_event(number)
            if lane >= 0:
                heard.append(lane)
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
            elif isinstance(value, DailyUpdate):
                rest = RestOfBatch(batch, row, events, number + 1, order, value.midnight)
                yield self._cut_off(batch, piece, row, heard), rest
                piece, heard = Piece(row, row, _NO_KINDS, [], [], []), []
        yield self._cut_off(batch, piece, batch.size, heard), None

    def _cut_off(self, batch: Batch, piece: Piece, stop: int, heard: list[int]) -> Piece:
        """Return a piece that ends before a row; count its samples and those lost, and find the kinds of their cars."""
        self._silent_cars.hear(heard, samples=False)
        rows, replaced = batch.rows(piece.start, stop), list[ReplacedKind]()
        self._silent_cars.hear(rows.lane)
        kind = self._context.cars.kinds(rows.lane, piece.changes, len(self._context.lanes), replaced)
        self._decoder.losses.count(rows, self._context.cars.period.take(kind) != 0.0)
        self._pending.add_replaced(replaced)
        return piece._replace(stop=stop, kind=kind)

    def _take_ride(self, place: int, lane: int, ride: Ride) -> tuple[float, float, bool]:
        """Take the driver of a ride; return the code of its name, when it begins or ends, and whether it ends."""
        self._totals.observe_driver(ride, lane, place)
        if ride.driver_id and ride.event == "start":
            self._pending.add_arrival(DriverNamed(place, lane, ride.driver_id))
        return self._decoder.rides.get(ride.ride_id, UNKNOWN_NAME), ride.time_s, ride.event == "end"

    def _take_plan(self, place: int, lane: int, plan: Plan) -> None:
        """Take a plan, which dispatch sends, or count why it cannot be used."""
        if (cause := self._plans.refuse(lane, plan)) is not None:
            self._decoder.refuse("plan", cause)
        elif self._pending.keep:
            self._plans.accept(lane, plan)
            self._pending.add_arrival(PlanArrival(place, lane, plan))

    def _take_weather(self, place: int, event: Event, value: Weather, piece: Piece, refusals: list[Refused]) -> None:
        """Take an observation or a forecast of a station, or refuse it and count why."""
        stations = self._totals.stations if value.issued_s is None else self._weather
        if (cause := stations.admit(value)) is not None:
            self._decoder.refuse("weather", cause)
            refusals.append(Refused(event.message, None, event.number))
        elif value.issued_s is None:
            piece.observations.append((event.row, value))
        else:
            self._pending.add_arrival(ForecastArrival(place, value))
