"""`socast spikein` puts the energy that it names into a recording, and nothing else."""

import json
from math import sin

import msgspec
import numpy as np
import pytest

from socast.core.wire.messages import Message, Telemetry, Vehicle, encode
from socast.stream.mcap_reader import McapSource
from socast.stream.mcap_writer import McapSink
from tests.support.commands import done, refused
from tests.support.paths import RECORDINGS

SHIFT = RECORDINGS / "shift.mcap"


def read(path):
    """Return the messages of a recording."""
    return [message for block in McapSource(path) for message in block]


def spike(folder, recording, *options):
    """Put an effect into a recording; return its messages and its truth."""
    out = folder / "spiked.mcap"
    done("spikein", recording, "--out", out, *options)
    return read(out), json.loads((folder / "spiked.mcap.truth.json").read_text())


def write_car(path, *, current=True, days=2):
    """Write a recording of one car that drives an hour at 15 m/s each day, and charges between."""
    messages = [Message("fleet/car/vehicle", encode(Vehicle("car", 0.0, "nissan_leaf_2013")), 0)]
    for day in range(days):
        for second in range(0, 3600, 3):
            at = 1.7e9 + 86400.0 * day + second
            known = {"battery_current_a": 40.0 + 5.0 * sin(second / 30.0)} if current else {}
            sample = Telemetry(
                "car",
                at,
                speed_kmh=54.0,
                battery_voltage_v=360.0,
                soc_pct=90.0 - second / 100.0,
                ambient_c=5.0,
                **known,
            )
            messages.append(Message("fleet/car/telemetry", encode(sample), round(at * 1e9)))
    with McapSink(path) as sink:
        sink.put(messages)
    return path


def sum_added(before, after):
    """Return the energy that was added to the samples of a car that sends every 3 s. [kWh]"""
    one, other = ([msgspec.json.decode(each.payload) for each in messages] for messages in (before, after))
    samples = [(a, b) for a, b in zip(one, other, strict=True) if "battery_current_a" in a]
    return (
        sum((b["battery_current_a"] - a["battery_current_a"]) * a["battery_voltage_v"] * 3.0 for a, b in samples)
        / 3.6e6
    )


@pytest.mark.parametrize("effect", ["standby", "cold_rolling", "cold_rolling~other", "cabin_heating"])
def test_energy_that_is_put_in_is_that_of_the_truth_and_has_the_size(effect, tmp_path):
    recording = write_car(tmp_path / "car.mcap")
    after, truth = spike(tmp_path, recording, "--effect", effect, "--size", "4%")
    energy = sum(drive["energy_kwh"] for drive in truth["drives"])
    measured = 2 * 40.0 * 360.0 * 3600.0 / 3.6e6
    assert energy == pytest.approx(0.04 * measured, rel=0.01)
    assert sum_added(read(recording), after) == pytest.approx(energy, rel=0.01)


def test_all_but_current_or_charge_stays(tmp_path):
    after, truth = spike(tmp_path, SHIFT, "--effect", "headwind")
    before = read(SHIFT)
    assert len(before) == len(after)
    changed = 0
    for one, other in zip(before, after, strict=True):
        assert (one.key, one.receipt_ns) == (other.key, other.receipt_ns)
        if one.payload != other.payload:
            a, b = msgspec.json.decode(one.payload), msgspec.json.decode(other.payload)
            field = truth["fields"][a["vehicle_id"]]
            assert a.pop(field) != b.pop(field)
            assert a == b
            changed += 1
    assert 1000 < changed <= truth["samples"]
    assert set(truth["fields"].values()) == {"battery_current_a", "soc_pct"}
    assert not truth["made_weather"]


def test_effect_of_one_car_since_a_time_changes_only_that(tmp_path):
    names = sorted({each.key.split("/")[1] for each in read(SHIFT) if each.key.endswith("/telemetry")})
    middle = float(np.median([each.receipt_ns for each in read(SHIFT)])) * 1e-9
    day = np.datetime_as_string(np.datetime64(round(middle), "s"))
    after, truth = spike(tmp_path, SHIFT, "--effect", "standby", "--vehicles", names[1], "--since", day)
    assert {drive["vehicle_id"] for drive in truth["drives"]} == {names[1]}
    assert all(drive["begin_s"] >= middle - 1.0 for drive in truth["drives"])
    touched = {b.key for a, b in zip(read(SHIFT), after, strict=True) if a.payload != b.payload}
    assert touched == {f"fleet/{names[1]}/telemetry"}


def test_charge_of_a_car_without_current_falls_by_the_energy_and_recovers_by_charging(tmp_path):
    recording = write_car(tmp_path / "car.mcap", current=False)
    after, truth = spike(tmp_path, recording, "--effect", "standby", "--size", "5%")
    assert truth["fields"] == {"car": "soc_pct"}
    charge = [
        [msgspec.json.decode(each.payload)["soc_pct"] for each in messages if each.key.endswith("/telemetry")]
        for messages in (read(recording), after)
    ]
    fallen = np.array(charge[0]) - np.array(charge[1])
    assert fallen[1199] == pytest.approx(0.05 * 36.0, abs=0.06)  # a drive takes 36 %
    assert fallen[1200] == pytest.approx(0.0, abs=0.05)
    assert (np.diff(fallen[:1200]) >= -0.1001).all()


def test_weather_is_made_up_where_the_effect_needs_it_and_there_is_none(tmp_path):
    after, truth = spike(tmp_path, write_car(tmp_path / "car.mcap"), "--effect", "headwind")
    stations = [each for each in after if each.key == "weather/made-up"]
    assert truth["made_weather"]
    assert len(stations) >= 48
    receipts = [each.receipt_ns for each in after]
    assert receipts == sorted(receipts)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--effect", "magnetism"), "choose from"),
        (("--effect", "standby", "--size", "90%"), "at most 50%"),
        (("--effect", "standby", "--size", "some"), "such as 3%"),
        (("--effect", "standby", "--vehicles", "horse"), "no car horse"),
        (("--effect", "standby", "--since", "2030-01-01"), "no energy is measured"),
        (("--effect", "snow"), "too little"),
    ],
)
def test_request_that_cannot_be_met_is_refused_in_one_line(options, words, tmp_path, capsys):
    error = refused(capsys, "spikein", write_car(tmp_path / "car.mcap"), "--out", tmp_path / "out.mcap", *options)
    assert words in " ".join(error.split())
    assert not (tmp_path / "out.mcap").exists()
