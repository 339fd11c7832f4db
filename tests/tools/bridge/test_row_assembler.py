"""Signals that come one by one become rows, with their units, times and tickets."""

import json

import pytest

from socast.tools.bridge.row_assembler import FIX, HOLD_S, MOST_VEHICLES, RowAssembler, Value
from socast.tools.importers.table.units import POWER

NOW = 1_700_000_000.0


def take(assembler, field, value, at=0.0, *, car="taxi-7", time_s=None, rank=0, ticket=None):
    """Give the assembler a value that came some seconds after `NOW`."""
    assembler.take(Value(car, field, value, NOW + at, time_s, rank, ticket))


def rows(assembler):
    """Return the complete rows, as decoded messages of telemetry."""
    messages, _ = assembler.pop()
    return [json.loads(message.payload) for message in messages if message.key.endswith("/telemetry")]


def test_values_of_one_period_are_one_row():
    assembler = RowAssembler()
    take(assembler, "speed_kmh", 50.0)
    take(assembler, "soc_pct", 80.0, 0.4)
    assert rows(assembler) == []
    assembler.close_due(NOW + 1.0)
    (row,) = rows(assembler)
    assert row == {"vehicle_id": "taxi-7", "time_s": NOW + 0.4, "seq": 0, "speed_kmh": 50.0, "soc_pct": 80.0}


def test_later_value_completes_the_row_and_the_counter_rises():
    assembler = RowAssembler()
    for at in range(3):
        take(assembler, "speed_kmh", 50.0 + at, at)
    assembler.close_due()
    assert [(row["seq"], row["speed_kmh"]) for row in rows(assembler)] == [(0, 50.0), (1, 51.0), (2, 52.0)]


def test_newer_value_of_a_period_replaces_the_older_one_and_is_counted():
    assembler = RowAssembler(period_s=3.0)
    for at in range(3):
        take(assembler, "speed_kmh", 50.0 + at, at)
    assembler.close_due()
    (row,) = rows(assembler)
    assert row["speed_kmh"] == 52.0
    assert assembler.counts["overwritten"] == 2


def test_rows_have_the_time_of_the_car_where_it_gives_one():
    assembler = RowAssembler()
    for step in (0, 5):  # a backlog: both moments come at once
        assembler.set_clock("taxi-7", NOW - 3600.0 + step, NOW)
        take(assembler, "speed_kmh", 40.0 + step, 0.001 * step)
        take(assembler, "soc_pct", 80.0, 0.001 * step)
    assembler.close_due()
    assert [(row["time_s"], row["speed_kmh"]) for row in rows(assembler)] == [
        (NOW - 3600.0, 40.0),
        pytest.approx((NOW - 3595.0, 45.0)),
    ]


def test_first_time_of_a_car_holds_for_what_came_just_before():
    assembler = RowAssembler()
    take(assembler, "speed_kmh", 40.0)
    assembler.set_clock("taxi-7", NOW - 3600.0, NOW + 0.1)
    assembler.close_due()
    assert rows(assembler)[0]["time_s"] == NOW - 3600.0


def test_values_after_an_interruption_belong_to_the_last_time_of_the_car():
    assembler = RowAssembler()
    assembler.set_clock("taxi-7", NOW, NOW)
    take(assembler, "speed_kmh", 40.0)
    assembler.close_due()
    assembler.interrupt()
    take(assembler, "soc_pct", 80.0, 600.0)
    assembler.set_clock("taxi-7", NOW + 5.0, NOW + 600.0)
    take(assembler, "soc_pct", 79.0, 600.0)
    assembler.close_due()
    first, rest, following = rows(assembler)
    assert [first["time_s"], rest["time_s"], following["time_s"]] == [NOW, NOW, NOW + 5.0]
    assert [rest["soc_pct"], following["soc_pct"]] == [80.0, 79.0]


def test_time_of_a_clock_that_was_never_set_is_counted_and_not_used():
    assembler = RowAssembler()
    assembler.set_clock("taxi-7", 12.0, NOW)
    take(assembler, "speed_kmh", 40.0)
    take(assembler, "soc_pct", 80.0, time_s=12.0)
    assembler.close_due()
    assert rows(assembler)[0]["time_s"] == NOW
    assert assembler.counts["bad_time"] == 2


def test_signal_without_news_is_held_for_a_while():
    assembler = RowAssembler()
    take(assembler, "speed_kmh", 0.0)
    take(assembler, "charging", 1.0)
    take(assembler, "odometer_km", 1234.5)
    for at in (HOLD_S, HOLD_S + 1.0):
        take(assembler, "soc_pct", 80.0, at)
    assembler.close_due()
    _, held, forgotten = rows(assembler)
    assert (held["speed_kmh"], held["charging"]) == (0.0, True)
    assert "odometer_km" not in held
    assert "speed_kmh" not in forgotten
    assert forgotten["charging"] is True


def test_coordinate_that_did_not_change_is_held_beside_the_other_one():
    assembler = RowAssembler()
    take(assembler, "latitude_deg", 45.5)
    take(assembler, "longitude_deg", -73.6)
    take(assembler, "latitude_deg", 45.6, 5.0)
    take(assembler, "speed_kmh", 30.0, 10.0)
    take(assembler, "longitude_deg", -73.5, 10.0 + HOLD_S)
    assembler.close_due()
    _, north, moving, alone = rows(assembler)
    assert (north["latitude_deg"], north["longitude_deg"]) == (45.6, -73.6)
    assert "latitude_deg" not in moving
    assert "longitude_deg" not in alone


def test_fast_signal_is_held_as_long_as_told_and_a_slow_one_longer():
    assembler = RowAssembler(hold_s=10.0)
    take(assembler, "battery_current_a", 20.0)
    take(assembler, "ambient_c", -5.0)
    take(assembler, "soc_pct", 80.0, 20.0)
    assembler.close_due()
    assert rows(assembler)[1].keys() == {"vehicle_id", "time_s", "seq", "soc_pct", "ambient_c"}


def test_position_without_a_fix_is_left_out():
    assembler = RowAssembler()
    take(assembler, FIX, 0.0)
    take(assembler, "latitude_deg", 0.0)
    take(assembler, "speed_kmh", 30.0)
    assembler.close_due()
    assert "latitude_deg" not in rows(assembler)[0]
    assert assembler.counts["no_fix"] == 1


def test_preferred_source_of_a_field_wins_while_it_speaks():
    assembler = RowAssembler()
    take(assembler, "speed_kmh", 49.0, 0.0, rank=1)
    take(assembler, "speed_kmh", 50.0, 0.1)
    take(assembler, "speed_kmh", 51.0, 0.2, rank=1)
    assembler.close_due()
    take(assembler, "speed_kmh", 12.0, 1000.0, rank=1)
    assembler.close_due()
    assert [row["speed_kmh"] for row in rows(assembler)] == [50.0, 12.0]
    assert assembler.counts["other_source"] == 1


def test_power_becomes_voltage_and_current():
    assembler = RowAssembler(nominal_voltage=400.0)
    take(assembler, POWER, 20.0)
    take(assembler, POWER, 20.0, 1.0)
    take(assembler, "battery_voltage_v", 500.0, 1.0)
    assembler.close_due()
    assert [(row["battery_voltage_v"], row["battery_current_a"]) for row in rows(assembler)] == [
        (400.0, 50.0),
        (500.0, 40.0),
    ]


def test_gone_sender_takes_its_held_signals_along():
    assembler = RowAssembler()
    take(assembler, "speed_kmh", 50.0)
    assembler.disconnect("taxi-7")
    take(assembler, "soc_pct", 80.0, 1.0)
    assembler.close_due()
    before, after = rows(assembler)
    assert before["speed_kmh"] == 50.0
    assert "speed_kmh" not in after


def test_tickets_come_back_with_the_row_that_holds_their_values():
    assembler = RowAssembler()
    assembler.set_clock("taxi-7", NOW, NOW, "clock")
    take(assembler, "speed_kmh", 50.0, ticket="speed")
    take(assembler, "latitude_deg", 45.0, car="not a name", ticket="refused")
    assert assembler.pop() == ([], ["refused"])
    assembler.close_due()
    messages, tickets = assembler.pop()
    assert len(messages) == 1
    assert tickets == ["clock", "speed"]


def test_car_with_a_model_is_introduced_once():
    assembler = RowAssembler(models={"*": "nissan-leaf-2016", "taxi-8": "bmw-i3-2014"})
    for at in (0.0, 5.0):
        take(assembler, "speed_kmh", 50.0, at)
        take(assembler, "speed_kmh", 50.0, at, car="taxi-8")
    assembler.close_due()
    introductions = [message for message in assembler.pop()[0] if message.key.endswith("/vehicle")]
    assert [json.loads(each.payload)["model"] for each in introductions] == ["nissan-leaf-2016", "bmw-i3-2014"]


def test_number_of_cars_is_limited(monkeypatch):
    monkeypatch.setattr("socast.tools.bridge.row_assembler.MOST_VEHICLES", 2)
    assembler = RowAssembler()
    for car in ("a", "b", "c"):
        take(assembler, "speed_kmh", 50.0, car=car)
    assert assembler.vehicles == 2
    assert assembler.counts["too_many_vehicles"] == 1
    assert MOST_VEHICLES > 2
