"""The condition of a fleet names the car that changed, has cars with a finding first, and finds the usable capacity."""

import numpy as np
import pandas as pd
import pytest

from socast.core import models
from socast.core.condition import car_condition
from socast.core.condition.car_condition import assess_condition, follow_beside_siblings
from socast.core.condition.car_days import CarDays
from socast.core.errors import ModelError
from socast.core.formatting import word_date
from socast.tools.bench.condition_fleets import make_fleet
from socast.tools.report.condition import describe_fleet

MODEL = models.BASIC_PHYSICAL
NAMES = [f"car-{number}" for number in range(8)]


def assess(monkeypatch, consumption, capacity=None, cold=None):
    """Return the condition of made-up car-days."""
    capacity = consumption._replace(value=np.full(consumption.value.shape, np.nan)) if capacity is None else capacity
    cold = np.zeros(consumption.value.shape) if cold is None else cold
    cars = len(consumption.value)
    days = CarDays(NAMES[:cars], ["m"] * cars, np.full(cars, 30.0), consumption, capacity, cold)
    compared = type("Compared", (), {"rides": [], "left_out": {"too short": 2}})
    monkeypatch.setattr(car_condition, "select_rides", lambda *_: compared)
    monkeypatch.setattr(car_condition, "gather_car_days", lambda *_: days)
    return assess_condition(pd.DataFrame(), MODEL)


def test_car_that_changed_comes_first_with_its_date(monkeypatch):
    found = assess(monkeypatch, make_fleet(7, step=0.15, at=70))
    car = found.cars[0]
    assert car.vehicle_id == "car-0"
    (step,) = car.consumption.steps
    assert step.interval[0] <= "2018-11-10" <= step.interval[1]
    assert step.change_pct == pytest.approx(16.0, abs=4.0)
    assert car.consumption.ci95_pct[0] > 0.0
    assert car.consumption.ci95_pct[0] < car.consumption.ci68_pct[0] < car.consumption.level_pct
    assert found.left_out == {"too short": 2}
    assert found.table["vehicle_id"].tolist()[0] == "car-0"
    assert found.table["consumption_since"][0] == step.since


def test_ageing_battery_is_told_from_the_cold(monkeypatch):
    rng = np.random.default_rng(4)
    consumption = make_fleet(8, days=400)
    time = np.arange(400)
    cold = np.broadcast_to(np.maximum(12.0 * np.sin(2.0 * np.pi * time / 365.0), 0.0), (8, 400))
    value = np.log(0.9) - 0.004 * cold + 0.01 * rng.normal(size=(8, 400))
    value[2] -= 0.08 * time / 365.0
    capacity = consumption._replace(value=value, amount=np.full((8, 400), 3600.0))
    found = assess(monkeypatch, consumption, capacity, cold)
    assert found.cold_loss_pct == pytest.approx(0.4, abs=0.05)
    by_name = {car.vehicle_id: car for car in found.cars}
    ageing, other = by_name["car-2"], by_name["car-5"]
    assert ageing.capacity.rate_pct == pytest.approx(-8.0, abs=2.0)
    assert ageing.capacity.is_changing
    assert not other.capacity.is_changing
    assert other.usable_kwh == pytest.approx(27.0, abs=0.3)
    assert other.capacity.rate_ci95_pct[0] < 0.0 < other.capacity.rate_ci95_pct[1]


@pytest.mark.parametrize("cars", [3, 4, 5])
def test_step_of_one_car_is_no_step_of_its_siblings(monkeypatch, cars):
    false = []
    for seed in range(6):
        found = assess(monkeypatch, make_fleet(seed, cars=cars, step=0.15, at=60))
        by_name = {car.vehicle_id: car.consumption.steps for car in found.cars}
        assert by_name.pop("car-0"), seed
        false += [bool(steps) for steps in by_name.values()]
    assert np.mean(false) < 0.15


def test_level_after_a_step_is_as_uncertain_as_its_days():
    held = []
    for seed in range(40):
        fleet = make_fleet(seed, step=0.1, at=100)
        truth = make_fleet(seed, step=0.1, at=100, is_noisy=False).value
        followed = follow_beside_siblings(fleet, ["m"] * 8)
        if followed.steps[0]:
            off = followed.path.level[0, -1] - followed.path.level[1:, -1].mean() - truth[0, -1] + truth[1:, -1].mean()
            held.append(abs(off) < 1.96 * followed.path.sd[0, -1])
    assert len(held) > 25
    assert np.mean(held) >= 0.85


def test_two_cars_are_compared_with_the_model(monkeypatch):
    found = assess(monkeypatch, make_fleet(3, cars=2))
    assert [car.siblings for car in found.cars] == [0, 0]
    lines = describe_fleet(found)
    assert not any("siblings" in line for line in lines)


def test_bad_battery_and_unknown_car_are_told(monkeypatch):
    fleet = make_fleet(10)
    fleet.value[1, 5:] = np.nan
    value = np.full((8, 120), np.log(0.99)) + 0.01 * np.random.default_rng(0).normal(size=(8, 120))
    value[3] += np.log(0.8)
    capacity = fleet._replace(value=value, amount=np.full((8, 120), 3600.0))
    found = assess(monkeypatch, fleet, capacity)
    lines = describe_fleet(found)
    (line,) = (each for each in lines if "car-3" in each)
    assert "its battery holds 20" in line
    assert "less (" in line
    assert f"than in the catalogue as of {word_date(found.last_date)}" in line
    assert "Too few dates tell of car-1." in lines


def test_few_days_tell_no_rate(monkeypatch):
    found = assess(monkeypatch, make_fleet(9, days=20))
    assert all(car.consumption.rate_pct is None for car in found.cars)


def test_car_with_few_days_has_no_trend(monkeypatch):
    fleet = make_fleet(10)
    fleet.value[1, 5:] = np.nan
    found = assess(monkeypatch, fleet)
    (car,) = [each for each in found.cars if each.vehicle_id == "car-1"]
    assert car.consumption is None
    assert car.usable_kwh is None


def test_no_rides_are_refused():
    with pytest.raises(ModelError, match="there are no rides"):
        assess_condition(pd.DataFrame(), MODEL)
