"""The live table shows the forecast charge at the end of each shift."""

import io

import pytest
from rich.console import Console

from socast.core.forecast.forecast_rows import PUBLISHED
from socast.core.pipeline import Pipeline
from socast.core.wire.messages import Interval, Message
from socast.stream.loop import Tally
from socast.tools.terminal.live_table import WARNED, LiveTable, make_fleet_table
from socast.tools.terminal.model_comparison import WIDE
from tests.support.fleet_days import DAY, DAYS, SHIFT, forecasts, plan, shift, trained_pipeline
from tests.support.statuses import make_status
from tests.support.telemetry import START, make_message


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
        for name in [*(each.name for each in PUBLISHED), "next_charge"]:
            assert getattr(by_car[car], name) == getattr(newest, name)


def test_all_counts_below_the_cars_are_those_of_this_process():
    pipeline = trained_pipeline()
    pipeline.push([m for _, m in shift("c", DAYS)])
    pipeline.push([Message("fleet/c/telemetry", b"rubbish", 0)])
    before = pipeline.quality()
    assert before["rides"] > 0
    console = Console(file=io.StringIO(), width=120, height=30, force_terminal=True)
    with LiveTable(pipeline, "Live", console=console, clock=iter(range(0, 100, 10)).__next__) as screen:
        screen(Tally(received=3, forecasts=2, seconds=1.0))
        pipeline.push([Message("fleet/c/telemetry", b"more rubbish", 0)])
        screen(Tally(received=4, forecasts=2, seconds=2.0))
    shown = " ".join(console.file.getvalue().split())
    assert "since the start: 3 messages (3 a second), 2 forecasts, 0 missed, 0 undecodable, 0 rides ended" in shown
    assert "since the start: 4 messages (2 a second), 2 forecasts, 0 missed, 1 undecodable, 0 rides ended" in shown


def test_a_line_every_thirty_seconds_names_the_zone_where_the_output_is_no_terminal():
    pipeline, console = trained_pipeline(), Console(file=io.StringIO(), width=200)
    pipeline.push([m for _, m in shift("c", DAYS)][:300])
    times = iter([0.0, 1.0, 29.0, 30.0, 31.0, 59.0, 61.0])
    with LiveTable(pipeline, "Live", console=console, clock=times.__next__) as screen:
        for _ in range(5):
            screen(Tally(seconds=1.0))
    lines = console.file.getvalue().splitlines()
    assert len(lines) == 2  # after 30 s, and the last one
    assert all(" UTC  c: SOC " in line for line in lines)


def test_restart_without_new_messages_shows_the_forecasts_that_were_published_last():
    pipeline = trained_pipeline()
    for car in "bc":
        pipeline.push([m for _, m in shift(car, DAYS)][: 200 if car == "b" else 300])
    state = pipeline.snapshot()
    again = Pipeline(settings=pipeline.settings)
    again.restore(state)
    assert again.snapshot() == state
    assert again.forecasts() == []
    assert again.status() == pipeline.status()
    assert {each.forecast.vehicle_id for each in again.status() if each.forecast.soc_end_of_shift_pct} >= set("bc")


def test_shift_of_a_car_past_its_plan_is_shown_as_over():
    pipeline = trained_pipeline()
    whole = [m for _, m in shift("c", DAYS)]
    pipeline.push(whole)
    later = START + DAY * DAYS + SHIFT
    pipeline.push([make_message("telemetry", "f", later + 5.0 * i, soc_pct=80.0) for i in range(1200)])
    (car,) = [status for status in pipeline.status() if status.forecast.vehicle_id == "c"]
    assert (car.is_shift_over, car.forecast.reserve_risk, car.forecast.soc_end_of_shift_pct) == (True, None, None)
    assert "shift over" in row(car)


def test_car_with_reserve_above_charge_is_marked_in_live_operation():
    pipeline = trained_pipeline()
    messages = [m for _, m in shift("c", DAYS)][:100]
    messages[1] = plan("c", DAYS, START + DAY * DAYS, reserve_soc_pct=95.0)
    pipeline.push(messages)
    (car,) = [status for status in pipeline.status() if status.forecast.vehicle_id == "c"]
    assert car.forecast.reserve_risk >= WARNED
    assert "!" in row(car)
