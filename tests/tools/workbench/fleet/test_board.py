"""A board shows the samples of batches as those in JSON, and takes nothing from batches that cannot be used."""

import json

import numpy as np
import pyarrow as pa
import pytest

from socast.core.wire.arrow_batch import PREFIX, write_rows
from socast.core.wire.messages import Message
from socast.core.wire.sample_reader import LIMITS
from socast.tools.bench.workbench import make_fleet_messages
from socast.tools.workbench.fleet import board as board_module
from socast.tools.workbench.fleet.board import Board
from socast.tools.workbench.fleet.density import TraceDensity
from tests.support.batched_recordings import GATEWAY, make_batch

PLACE = {"latitude_deg": 45.5, "longitude_deg": -73.6}


def make_samples(rng, cars=5, turns=200):
    """Return samples of cars that drive, with missing values, fixes at zero, single wrong fixes and one real move."""
    places, out = rng.normal((45.5, -73.6), 0.02, (cars, 2)), []
    for turn in range(turns):
        places += rng.normal(0.0, 0.002, places.shape)
        places[0] += 5.0 * (turn == turns // 2)
        for car, place in enumerate(places):
            fault = rng.choice([0.0, 20.0, np.nan], p=[0.9, 0.05, 0.05])
            latitude, longitude = (0.0, 0.0) if rng.random() < 0.03 else (place + fault).tolist()
            fields = {
                "latitude_deg": latitude,
                "longitude_deg": longitude,
                "speed_kmh": rng.uniform(0.0, 50.0),
                "soc_pct": rng.uniform(10.0, 90.0),
                "charging": bool(rng.random() < 0.1),
            }
            known = {name: value for name, value in fields.items() if value == value and rng.random() < 0.9}
            out.append({"vehicle_id": f"taxi-{car:04d}", "time_s": 1.7e9 + 3.0 * turn} | known)
    return out


def to_json(samples):
    return [Message(f"fleet/{each['vehicle_id']}/telemetry", json.dumps(each).encode(), 0) for each in samples]


def to_batches(samples, size):
    return [make_batch(samples[at : at + size]) for at in range(0, len(samples), size)]


def state_of(board):
    """Return what pages show of the cars and of their traces."""
    values = [board.get_values(name) for name in board.vehicle_ids]
    return board.vehicle_ids, repr(values), board.density.describe()


@pytest.mark.parametrize("size", [1, 7, 2000])
def test_board_given_batches_equals_board_given_the_same_samples_in_json(size, rng):
    samples, forecasts = make_samples(rng), make_fleet_messages(2, 0.0, rng)[1::2]
    first, last = samples[:500], samples[500:]
    one, other = Board(), Board()
    one.take([*to_json(first), *forecasts, *to_json(last)])
    other.take([*to_batches(first, size), *forecasts, *to_batches(last, size)])
    assert state_of(other) == state_of(one)
    assert len(one.density.describe()["count"]) > 100
    assert other.counts["batch"] == -(-500 // size) * 2
    assert other.counts["undecodable"] == 0


def test_batches_and_samples_in_json_are_taken_in_the_order_of_their_arrival(rng):
    samples = make_samples(rng)
    one, other = Board(), Board()
    one.take(to_json(samples))
    other.take([*to_json(samples[:300]), make_batch(samples[300:400]), *to_json(samples[400:])])
    assert state_of(other) == state_of(one)


def test_car_may_send_its_own_samples_as_a_batch():
    board = Board()
    board.take([make_batch([{"vehicle_id": "a", "time_s": 1e9, "speed_kmh": 30.0} | PLACE], "fleet/a/telemetry")])
    assert board.get_values("a")["latitude"] == 45.5
    assert board.counts == {"telemetry": 1}


def test_rows_of_other_cars_under_the_key_of_a_car_are_not_taken():
    board = Board()
    rows = [{"vehicle_id": name, "time_s": 1e9, "speed_kmh": speed} for name, speed in (("a", 30.0), ("b", 50.0))]
    board.take([make_batch(rows, "fleet/a/telemetry"), make_batch(rows[1:], "fleet/a/telemetry")])
    assert board.vehicle_ids == ["a"]
    assert board.get_values("a")["speed"] == 30.0
    assert board.counts == {"telemetry": 1, "undecodable": 1}


def test_rows_that_cannot_be_used_do_not_hide_the_others():
    board = Board()
    names, times = ["a", None, "c", "no name", "é", "f"], [1e9, 1e9, None, 1e9, 1e9, 1e9]
    speeds = [30.0, 30.0, 30.0, 30.0, 30.0, float("inf")]
    table = pa.table({"vehicle_id": names, "time_s": times, "speed_kmh": speeds})
    board.take([Message(GATEWAY, write_rows(table), 0)])
    assert board.vehicle_ids == ["a"]
    assert board.counts == {"batch": 1}


@pytest.mark.parametrize(
    "payload",
    [
        PREFIX,
        PREFIX + b"x" * 100,
        b'{"vehicle_id":"a","time_s":1e9}',
        write_rows(pa.table({"vehicle_id": ["a"]})),
        write_rows(pa.table({"vehicle_id": ["a"], "time_s": ["noon"]})),
        write_rows(pa.table({"vehicle_id": pa.array([], pa.string()), "time_s": pa.array([], pa.float64())})),
        write_rows(pa.table({"vehicle_id": ["a"] * 20_001, "time_s": [1e9] * 20_001})),
        write_rows(pa.table({"vehicle_id": ["a b"], "time_s": [1e9]})),
    ],
    ids=["mark", "damaged", "JSON", "no time", "text as time", "no rows", "too many rows", "impossible name"],
)
def test_batch_that_cannot_be_used_is_counted_and_changes_nothing(payload):
    board = Board()
    board.take([Message(GATEWAY, payload, 0)])
    assert (len(board), board.counts) == (0, {"undecodable": 1})


def test_batch_that_is_too_large_is_counted_and_changes_nothing(monkeypatch):
    batch, board = make_batch([{"vehicle_id": "a", "time_s": 1e9}]), Board()
    monkeypatch.setattr("socast.core.wire.sample_reader.LIMITS", LIMITS._replace(payload_bytes=len(batch.payload) - 1))
    board.take([batch])
    assert (len(board), board.counts) == (0, {"undecodable": 1})


def test_cars_of_batches_beyond_the_largest_number_are_not_shown(monkeypatch):
    monkeypatch.setattr(board_module, "MOST_CARS", 2)
    board = Board()
    board.take([make_batch([{"vehicle_id": name, "time_s": 1e9, "speed_kmh": 30.0} | PLACE for name in "abcab"])])
    assert board.vehicle_ids == ["a", "b"]
    assert sum(board.density.describe()["count"]) == 4


def test_traces_of_a_recording_of_batches_equal_those_of_the_same_samples_in_json(rng, monkeypatch):
    monkeypatch.setattr("socast.tools.workbench.fleet.density.MOST_CELLS", 200)
    samples, grids = make_samples(rng), []
    broken = Message(GATEWAY, PREFIX, 0)
    for block in (to_json(samples), [broken, *to_batches(samples, 64)]):
        density = TraceDensity()
        density.count_recordings([block])
        grids.append(density.describe())
    assert grids[0] == grids[1]
    assert grids[0]["cell"] > 0.0005
