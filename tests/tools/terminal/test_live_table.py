"""The live table shows the forecast charge at the end of each shift."""

import io

import pytest
from rich.console import Console

from socast.core.wire.messages import Interval
from socast.tools.terminal.live_table import WARNED, make_fleet_table
from socast.tools.terminal.model_comparison import WIDE
from tests.support.fleet_days import DAY, DAYS, forecasts, plan, shift, trained_pipeline
from tests.support.statuses import make_status
from tests.support.telemetry import START


def row(car, width=80):
    """Return the line of a car, as a terminal of some width shows it."""
    console = Console(file=io.StringIO(), width=width)
    console.print(make_fleet_table([car], "Live", "", 20, wide=width >= WIDE))
    (line,) = [line for line in console.file.getvalue().splitlines() if line.split()[:1] == [car.forecast.vehicle_id]]
    return line


@pytest.mark.parametrize("width", [80, 112])
@pytest.mark.parametrize(("risk", "mark"), [(0.0, False), (WARNED - 1e-9, False), (WARNED, True), (1.0, True)])
def test_car_that_risks_ending_below_reserve_is_marked(width, risk, mark):
    text = row(make_status(soc_end_of_shift_pct=Interval(34.4, 20.6, 61.0), reserve_risk=risk), width)
    assert "34 21–61" in text
    assert ("34 21–61!" in text) == mark


def test_cars_at_risk_come_first_and_are_never_left_out():
    cars = [
        make_status(f"taxi-{number}", 1.7e9 + number, reserve_risk={1: 0.97, 2: 0.4}.get(number)) for number in range(9)
    ]
    console = Console(file=io.StringIO(), width=80)
    console.print(make_fleet_table(cars, "Live", "", 4, wide=False))
    names = [line.split()[0] for line in console.file.getvalue().splitlines() if line.split()[:1] and "taxi-" in line]
    assert names == ["taxi-1", "taxi-2", "taxi-7", "taxi-8"]


def test_unknown_charge_at_end_is_dash():
    car, unknown = make_status(), ["–"] * 4
    assert row(car, 112).split() == ["taxi-1", "22:13:20", "64.0", "0.00", *unknown, "·" * 15 + "●" + "·" * 8]
    assert row(car).split() == ["taxi-1", "64.0", "0.00", *unknown, "·" * 7 + "●" + "·" * 4]


def test_status_holds_newest_forecast_of_each_car():
    pipeline = trained_pipeline()
    out = []
    for car in "bc":
        out += pipeline.push([m for _, m in shift(car, DAYS)][: 200 if car == "b" else 300])
    by_car = {status.forecast.vehicle_id: status.forecast for status in pipeline.status()}
    for car in "bc":
        newest = list(forecasts(out, car).values())[-1]
        for name in ("soc_pct", "soc_sd_pct", "range_km", "soc_end_of_shift_pct", "reserve_risk", "next_charge"):
            assert getattr(by_car[car], name) == getattr(newest, name)


def test_car_with_reserve_above_charge_is_marked_in_live_operation():
    pipeline = trained_pipeline()
    messages = [m for _, m in shift("c", DAYS)][:100]
    messages[1] = plan("c", DAYS, START + DAY * DAYS, reserve_soc_pct=95.0)
    pipeline.push(messages)
    (car,) = [status for status in pipeline.status() if status.forecast.vehicle_id == "c"]
    assert car.forecast.reserve_risk >= WARNED
    assert "!" in row(car)
