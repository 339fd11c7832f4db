"""A car whose clock is wrong silences no other car, and a car that is silent shows whoever sends."""

from types import SimpleNamespace

import numpy as np
import pytest

from socast.core.wire.messages import Forecast, Message, QualityCounts, encode
from socast.tools.workbench.fleet.alarms import list_alarms
from socast.tools.workbench.fleet.board import Board
from socast.tools.workbench.fleet.cars import describe_car
from socast.tools.workbench.fleet.frames import HEAD, encode_frame
from tests.support.outlooks import OUTLOOK

NOW = 1.7e9
DAY = 86_400.0


def forecast(car, time, risk=0.9, soc=60.0, ride="r", shift_end=None, **quality):
    """Return the forecast of a car."""
    counts = {name: quality.get(name, 0) for name in QualityCounts.__struct_fields__}
    energies = None, None, soc, 0.2, None, None, risk
    duration = 60.0 if ride else 0.0
    quality = QualityCounts(**counts)
    value = Forecast(car, NOW + time, ride, "model/1", 1.0, duration, *energies, quality=quality, shift_end_s=shift_end)
    return Message(f"fleet/{car}/forecast", encode(value), 0)


def run(board, cars, begin, end, step=15.0, ahead=0.0, **values):
    """Let cars send forecasts."""
    for time in np.arange(begin, end, step).tolist():
        board.take([forecast(car, time + ahead, **values) for car in cars])


def alarms(board):
    """Return the car and the value of each alarm by its kind."""
    kinds = {"reserve": {}, "silent": {}}
    for each in list_alarms(board)["list"]:
        kinds[each["kind"]][each["car"]] = each["value"]
    return kinds


@pytest.mark.parametrize("ahead", [9 * 60.0, 11 * 60.0, DAY, 400 * DAY, -DAY])
@pytest.mark.parametrize("cars", [1, 2, 30])
def test_sample_of_a_wrong_clock_silences_no_other_car(ahead, cars):
    board, others = Board(), [f"taxi-{at}" for at in range(cars)]
    run(board, [*others, "wrong"], 0.0, 120.0)
    board.take([forecast("wrong", 120.0 + ahead)])
    assert set(others) <= set(alarms(board)["reserve"])
    run(board, [*others, "wrong"], 120.0, 1500.0)
    assert alarms(board) == {"reserve": dict.fromkeys([*others, "wrong"], 0.9), "silent": {}}


@pytest.mark.parametrize("ahead", [11 * 60.0, DAY])
def test_car_whose_clock_stays_wrong_silences_no_other_car(ahead):
    board = Board()
    for time in np.arange(0.0, 1500.0, 15.0).tolist():
        board.take([forecast("a", time), forecast("wrong", time + ahead * (time > 60.0)), forecast("b", time)])
        assert alarms(board)["silent"] == {}
    head = HEAD.unpack_from(encode_frame(board, 1))
    assert head[3] == board.newest == NOW + 1485.0


@pytest.mark.parametrize(
    ("soc", "risk", "words"),
    [
        (0.0, 0.99, "is empty"),
        (30.0, 0.9, "was likely to end below its reserve when it sent last"),
        (30.0, 0.2, None),
    ],
)
def test_alarm_of_a_car_that_ran_low_stays_when_it_falls_silent(soc, risk, words):
    board = Board()
    run(board, ["gone"], 0.0, 60.0, risk=risk, soc=soc)
    run(board, ["a"], 75.0, 1500.0, risk=0.0)
    found = [each["words"] for each in list_alarms(board)["list"] if each["kind"] == "reserve"]
    assert found == ([] if words is None else [words])


@pytest.mark.parametrize(
    ("ride", "shift_end", "soc", "words"),
    [
        (None, NOW + 60.0, 30.0, None),
        (None, NOW + 60.0, 0.0, "is empty"),
        ("r", NOW + 60.0, 30.0, "was likely to end below its reserve when it sent last"),
        (None, None, 30.0, "was likely to end below its reserve when it sent last"),
        (None, NOW + 7200.0, 30.0, "was likely to end below its reserve when it sent last"),
    ],
)
def test_car_between_rides_past_the_end_of_its_shift_has_no_risk_left(ride, shift_end, soc, words):
    board = Board()
    run(board, ["ended"], 0.0, 60.0, soc=soc, ride=ride, shift_end=shift_end)
    run(board, ["a"], 75.0, 2000.0, risk=0.0)
    found = [each["words"] for each in list_alarms(board)["list"] if each["kind"] == "reserve"]
    assert found == ([] if words is None else [words])
    is_over = ride is None and shift_end == NOW + 60.0
    assert bool(board.find_over()[0]) is is_over
    fleet = SimpleNamespace(board=board, get_parts=lambda _: None, ask=lambda *_: OUTLOOK)
    record = describe_car(SimpleNamespace(fleet=fleet), SimpleNamespace(path={"car": "ended"}))
    assert (record["is_shift_over"], np.isnan(record["values"]["reserve_risk"])) == (is_over, is_over)


def test_shift_of_a_car_that_was_silent_for_hours_is_over():
    board = Board()
    run(board, ["gone"], 0.0, 60.0, ride=None)
    run(board, ["a"], 75.0, 7400.0, step=60.0)
    assert board.find_over().tolist() == [True, False]


def test_two_wrong_clocks_silence_the_others_only_until_their_next_forecasts():
    board = Board()
    run(board, "abc", 0.0, 100.0)
    board.take([forecast("x", 100.0), forecast("y", 100.0), forecast("x", 100.0 + DAY), forecast("y", 100.0 + DAY)])
    run(board, "abc", 105.0, 106.0)
    assert set("abc") <= set(alarms(board)["reserve"])


@pytest.mark.parametrize("wrong", [None, 11 * 60.0, DAY, -DAY])
def test_car_that_fell_silent_shows_after_ten_minutes_of_the_others(wrong):
    board = Board()
    run(board, ["a", "b", "gone"], 0.0, 60.0)
    if wrong is not None:
        board.take([forecast("b", 60.0 + wrong)])
    run(board, "ab", 75.0, 600.0)
    assert alarms(board)["silent"] == {}
    run(board, "ab", 600.0, 900.0)
    found = alarms(board)
    assert (set(found["silent"]), set(found["reserve"])) == ({"gone"}, {"a", "b", "gone"})
    assert found["silent"]["gone"] in {13, 14}


def test_only_car_with_a_clock_ahead_shows_that_another_is_silent():
    board = Board()
    run(board, ["a", "gone"], 0.0, 60.0)
    run(board, "a", 75.0, 900.0, ahead=DAY)
    assert set(alarms(board)["silent"]) == {"gone"}


def test_pause_of_the_whole_fleet_counts_once_two_cars_are_back():
    board = Board()
    run(board, "abc", 0.0, 60.0)
    board.take([forecast("a", 8 * 3600.0)])
    assert alarms(board)["silent"] == {}
    board.take([forecast("b", 8 * 3600.0 + 5.0)])
    assert alarms(board)["silent"] == {"c": 479}
    run(board, "ab", 8 * 3600.0 + 10.0, 8 * 3600.0 + 300.0)
    assert set(alarms(board)["silent"]) == {"c"}


def test_return_to_an_earlier_state_returns_to_its_time():
    board = Board()
    run(board, ["a", "b", "gone"], 0.0, 60.0)
    state = board.dump()
    run(board, "ab", 60.0, 900.0)
    later = alarms(board)
    board.load(state)
    assert alarms(board)["silent"] == {}
    run(board, "ab", 60.0, 900.0)
    assert alarms(board) == later


@pytest.mark.parametrize("count", [10**400, -1, 2**64])
def test_forecast_with_impossible_counts_is_left_out(count):
    board = Board()
    good = forecast("a", 0.0, repaired_time=1)
    forged = good._replace(payload=good.payload.replace(b'"repaired_time":1', b'"repaired_time":%d' % count))
    assert forged != good
    board.take([forged, forecast("b", 0.0)])
    assert (board.vehicle_ids, board.counts) == (["b"], {"forecast": 1, "impossible": 1})


@pytest.mark.parametrize("field", ["time_s", "ride_distance_km", "soc_pct", "reserve_risk"])
def test_forecast_with_a_number_of_400_digits_breaks_nothing(field):
    board = Board()
    head, _, rest = forecast("a", 0.0).payload.partition(f'"{field}":'.encode())
    forged = head + f'"{field}":1{"0" * 400}'.encode() + rest[rest.index(b",") :]
    board.take([Message("fleet/a/forecast", forged, 0), forecast("b", 0.0)])
    assert "b" in board.vehicle_ids
    encode_frame(board, 1)
    list_alarms(board)
