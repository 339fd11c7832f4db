"""Known events stand beside the sudden changes of their cars, and alter nothing else."""

from msgspec.structs import replace

from socast.core.condition.known_events import place_events
from socast.core.condition.records import CarCondition, CarEvent, ConditionStep, FleetCondition, Trend
from socast.core.diagnose.inference.events import KnownEvent

DATES = ["2018-11-01", "2018-11-05", "2018-11-12", "2018-11-13", "2018-11-20", "2018-11-28"]


def make_trend(*steps):
    """Return a trend with steps of these intervals."""
    made = [
        ConditionStep(since=low, interval=(low, high), change_pct=6.0, ci95_pct=(4.0, 8.0), probability=1.0)
        for low, high in steps
    ]
    level = {"level_pct": 6.0, "ci68_pct": (5.0, 7.0), "ci95_pct": (4.0, 8.0), "rate_pct": None, "rate_ci95_pct": None}
    return Trend(days=len(DATES), steps=made, dates=DATES, **level)


def make_fleet(*cars):
    """Return the condition of cars."""
    return FleetCondition(
        model="m",
        rides=9,
        car_days=9,
        car_days_left_out=0,
        energy_left_out=0.0,
        first_date=DATES[0],
        last_date=DATES[-1],
        left_out={},
        day_sd_pct=4.0,
        cold_loss_pct=None,
        cars=list(cars),
    )


def make_car(name="a", consumption=None, capacity=None):
    """Return the condition of a car."""
    return CarCondition(
        vehicle_id=name, vehicle_model="m", siblings=3, consumption=consumption or make_trend(), capacity=capacity
    )


def place_one(event, *steps):
    """Return the only car of a fleet with one event."""
    return place_events(make_fleet(make_car(consumption=make_trend(*steps))), [event]).cars[0]


def test_event_is_dated_from_the_nearest_step():
    steps = ("2018-11-05", "2018-11-05"), ("2018-11-12", "2018-11-13")
    (event,) = place_one(KnownEvent("2018-11-20", "a", "new tyres"), *steps).events
    assert event == CarEvent(date="2018-11-20", what="new tyres", step_since="2018-11-12", days_after_step=8)
    assert event.to_json() == {
        "date": "2018-11-20",
        "what": "new tyres",
        "step_since": "2018-11-12",
        "days_after_step": 8,
    }
    (event,) = place_one(KnownEvent("2018-11-04", "a"), *steps).events
    assert event.days_after_step == -1


def test_event_without_a_step_has_no_distance():
    (event,) = place_one(KnownEvent("2018-11-20", "a", "new tyres")).events
    assert event.to_json() == {"date": "2018-11-20", "what": "new tyres"}


def test_step_holds_events_whose_first_dates_with_driving_lie_in_its_interval():
    step = "2018-11-12", "2018-11-13"
    held = {}
    for day in ("2018-11-01", "2018-11-02", "2018-11-06", "2018-11-13", "2018-11-14"):
        car = place_one(KnownEvent(day, "a"), step)
        held[day] = [each.date for each in car.consumption.steps[0].events]
    assert held == {
        "2018-11-01": [],
        "2018-11-02": ["2018-11-02"],  # it drove on the 5th, and on the 12th next
        "2018-11-06": ["2018-11-06"],
        "2018-11-13": ["2018-11-13"],
        "2018-11-14": [],
    }


def test_event_of_all_cars_is_told_once_and_held_by_steps_of_any_car():
    step = "2018-11-12", "2018-11-13"
    fleet = make_fleet(make_car("a", make_trend(step)), make_car("b", capacity=make_trend(step)))
    found = place_events(fleet, [KnownEvent("2018-11-12", "", "update")])
    assert [each.what for each in found.events] == ["update"]
    assert [car.events for car in found.cars] == [[], []]
    assert [each.what for each in found.cars[0].consumption.steps[0].events] == ["update"]
    assert [each.what for each in found.cars[1].capacity.steps[0].events] == ["update"]


def test_events_of_other_cars_and_dates_are_counted():
    events = [KnownEvent("2018-11-12", "van"), KnownEvent("2018-10-31", "a"), KnownEvent("2018-11-29", "")]
    found = place_events(make_fleet(make_car()), events)
    assert found.events_left_out == 3
    assert replace(found, events_left_out=0) == make_fleet(make_car())


def test_car_without_a_trend_keeps_its_events():
    car = CarCondition(vehicle_id="a", vehicle_model="m", siblings=0)
    found = place_events(make_fleet(car), [KnownEvent("2018-11-12", "a", "brakes")])
    assert [each.what for each in found.cars[0].events] == ["brakes"]
