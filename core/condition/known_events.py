"""Place known events, such as repairs and new tyres, beside the sudden changes of cars."""

from bisect import bisect_left
from collections.abc import Sequence
from datetime import date

from msgspec.structs import replace

from socast.core.condition.records import CarCondition, CarEvent, ConditionStep, FleetCondition, Trend
from socast.core.diagnose.inference.events import KnownEvent


def place_events(found: FleetCondition, events: Sequence[KnownEvent]) -> FleetCondition:
    """Return the condition of a fleet with the events of its cars between its first and its last date."""
    names = {car.vehicle_id for car in found.cars}
    known = sorted(
        each for each in events if found.first_date <= each.date <= found.last_date and each.vehicle in {"", *names}
    )
    return replace(
        found,
        cars=[_place(car, [each for each in known if each.vehicle in {"", car.vehicle_id}]) for car in found.cars],
        events=[CarEvent(date=each.date, what=each.what) for each in known if not each.vehicle],
        events_left_out=len(events) - len(known),
    )


def _place(car: CarCondition, events: Sequence[KnownEvent]) -> CarCondition:
    """Return a car with its own events, and its steps with those that they may be due to."""
    steps = [step for trend in (car.consumption, car.capacity) if trend for step in trend.steps]
    own = [_describe(each, steps) for each in events if each.vehicle]
    return replace(car, consumption=_mark(car.consumption, events), capacity=_mark(car.capacity, events), events=own)


def _mark(trend: Trend | None, events: Sequence[KnownEvent]) -> Trend | None:
    """Return a trend whose steps hold the events within the interval of their date.

    A change shows on the first date with a measurement from the event on, or on the next one: a file may give the date
    of the visit itself, on which the car drove before it.
    """
    if trend is None or not events:
        return trend
    ends = [*trend.dates, "9999", "9999"]
    shown = [ends[bisect_left(ends, each.date) :][:2] for each in events]

    def mark(step: ConditionStep) -> ConditionStep:
        low, high = step.interval
        pairs = zip(events, shown, strict=True)
        held = [_describe(each, [step]) for each, days in pairs if any(low <= day <= high for day in days)]
        return replace(step, events=held)

    return replace(trend, steps=[mark(step) for step in trend.steps])


def _describe(event: KnownEvent, steps: Sequence[ConditionStep]) -> CarEvent:
    """Return an event with its distance from the nearest step."""
    day = date.fromisoformat(event.date)
    after = {step.since: (day - date.fromisoformat(step.since)).days for step in steps}
    nearest = min(after, key=lambda since: abs(after[since]), default=None)
    return CarEvent(
        date=event.date,
        what=event.what,
        step_since=nearest,
        days_after_step=None if nearest is None else after[nearest],
    )
