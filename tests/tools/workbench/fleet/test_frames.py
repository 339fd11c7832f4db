"""A frame holds every car in few bytes, and unknown values as unknown."""

import json

import numpy as np
import pytest

from socast.core.wire.messages import Message
from socast.tools.bench.workbench import make_fleet_messages
from socast.tools.workbench.fleet.alarms import MOST_ALARMS, list_alarms
from socast.tools.workbench.fleet.board import MOST_POINTS, POINT, Board, History
from socast.tools.workbench.fleet.frames import COLUMNS, HEAD, SILENT, describe_frames, encode_frame


def decode_frame(frame):
    """Return the columns of a frame as a browser reads them."""
    described = json.loads(json.dumps(describe_frames()))
    cars, _, _, _ = HEAD.unpack_from(frame)
    at, out = described["head"], {}
    for column in described["columns"]:
        dtype = np.dtype(f"<{column['dtype']}")
        assert at % dtype.itemsize == 0, "a typed array of a browser begins at a multiple of its width"
        numbers = np.frombuffer(frame, dtype, cars, at)
        out[column["name"]] = np.where(numbers == column["missing"], np.nan, numbers * column["scale"])
        at += cars * dtype.itemsize
    assert at == len(frame)
    return out


def test_thousand_cars_take_at_most_30_kilobytes(rng):
    board = Board()
    board.take(make_fleet_messages(1000, 0.0, rng))
    assert len(encode_frame(board, 1)) <= 30_000


def test_frame_keeps_the_values_to_their_resolution(rng):
    board = Board()
    board.take(make_fleet_messages(50, 0.0, rng))
    read = decode_frame(encode_frame(board, 1))
    for column in COLUMNS:
        if column.name not in {"age", "flags"}:
            expected = pytest.approx(board.column(column.name), abs=0.51 * column.scale + 1e-5, nan_ok=True)
            assert read[column.name] == expected


def test_unknown_values_stay_unknown_and_impossible_ones_stay_in_range():
    board = Board()
    board.take([Message("fleet/a/telemetry", b'{"vehicle_id":"a","time_s":1e9,"speed_kmh":1e30}', 0)])
    read = decode_frame(encode_frame(board, 1))
    assert np.isnan(read["soc_pct"][0])
    assert np.isnan(read["latitude"][0])
    assert read["speed"][0] == 254


@pytest.mark.parametrize(
    "payload",
    [b"", b"{", b"\xff", b"[]", b"null", b'{"time_s": "x"}', b"[" * 100_000, b'{"vehicle_id":"a","time_s":1e999}'],
)
def test_undecodable_messages_are_counted_and_change_nothing(payload):
    board = Board()
    board.take([Message(f"fleet/a/{kind}", payload, 0) for kind in ("telemetry", "forecast", "vehicle")])
    board.take([Message("findings/a/b", payload, 0), Message("nonsense", payload, 0)])
    encode_frame(board, 1)
    list_alarms(board)


def test_wrong_fix_moves_no_car_and_a_real_move_is_believed_at_the_second_fix():
    board = Board()

    def move(latitude, longitude):
        payload = {"vehicle_id": "a", "time_s": 1e9, "latitude_deg": latitude, "longitude_deg": longitude}
        board.take([Message("fleet/a/telemetry", json.dumps(payload).encode(), 0)])
        return board.get_values("a")["latitude"]

    assert move(45.5, -73.6) == 45.5
    assert move(0.0, 0.0) == 45.5
    assert move(12.0, -73.6) == 45.5
    assert move(45.501, -73.6) == 45.501
    assert move(46.2, -72.0) == 45.501
    assert move(46.2, -72.001) == 46.2


def test_alarms_name_cars_at_risk_first_and_cars_that_fell_silent(rng):
    board = Board()
    board.take(make_fleet_messages(10, 0.0, rng))
    board.take(make_fleet_messages(4, 700.0, rng))
    flags = decode_frame(encode_frame(board, 1))["flags"].astype(int)
    assert [bool(flag & SILENT) for flag in flags] == [False] * 4 + [True] * 6
    alarms = list_alarms(board)["list"]
    assert {alarm["car"] for alarm in alarms if alarm["kind"] == "silent"} == {f"taxi-{i:04d}" for i in range(4, 10)}
    board.take(make_fleet_messages(10, 701.0, rng))
    levels = [alarm["level"] for alarm in list_alarms(board)["list"]]
    assert levels == sorted(levels)
    assert levels.count("bad") == 4
    board.take(make_fleet_messages(1000, 702.0, rng))
    many = list_alarms(board)
    assert (many["total"], len(many["list"])) == (950, MOST_ALARMS)


def test_long_history_drops_its_oldest_points():
    history = History()
    for i in range(MOST_POINTS + 10):
        history.add(float(i), (1.0,) * len(POINT))
    time, values = history.tabulate()
    assert len(history) == MOST_POINTS + 10
    assert len(time) == len(values) <= MOST_POINTS
    assert time[-1] == MOST_POINTS + 9
