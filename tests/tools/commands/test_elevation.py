"""Test `socast elevation` and the option `--elevation` of commands that clean samples."""

import json

import pandas as pd
import pytest

from socast.core.wire.messages import Message
from tests.support.commands import called, done, refused
from tests.support.ground import hilly_drive, srtm_of_hills
from tests.support.mcap_recordings import BEGIN, make_telemetry, write_recording
from tests.support.telemetry import telemetry, without


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """Return a recording of three cars with offsets on the same road."""
    path = tmp_path_factory.mktemp("elevation") / "fleet.mcap"
    messages = [
        message
        for seed, (car, offset) in enumerate({"a": 0.0, "b": 12.0, "c": -12.0}.items())
        for message in telemetry(without(hilly_drive(200, seed=seed, offset=offset), "truth"), car)
    ]
    write_recording(path, sorted(messages, key=lambda message: message.receipt_ns))
    return path


@pytest.fixture(scope="module")
def learned(recording):
    path = recording.with_name("map.parquet")
    report = recording.with_name("learned.json")
    done("elevation", "learn", recording, "-o", path, "--json", report)
    return path, json.loads(report.read_text())


def test_learn_writes_a_map_and_says_what_it_learned(learned):
    path, report = learned
    places = pd.read_parquet(path)
    assert report["format"] == {"report": "elevation", "version": 1}
    assert report["map"]["places"] == len(places)
    assert report["learned"]["cars"] == 3
    assert 4.0 < report["learned"]["car_sd"] < 30.0


def test_show_prints_the_extent_of_a_map(learned):
    out, _, code = called("elevation", "show", learned[0])
    assert code == 0
    assert "45.5" in out
    assert "uncertainty" in out


@pytest.mark.parametrize("name", ["nothere", "folder/nothere.parquet"])
def test_show_without_a_file_names_it_and_the_remedy(name, capsys):
    message = refused(capsys, "elevation", "show", name)
    assert f"there is no map of elevation {name}; give a file that `socast elevation learn` wrote" in message
    assert "--elevation" not in message


def test_show_of_another_file_names_the_remedy(tmp_path, capsys):
    path = tmp_path / "N45W074.hgt"
    path.write_bytes(b"no table")
    message = refused(capsys, "elevation", "show", path)
    assert "cannot be read as a learned map of elevation" in message
    assert "make one with `socast elevation learn`" in message


def test_tables_with_a_map_have_other_climbs_and_count_fixes(recording, learned, tmp_path):
    done("tables", recording, "--out", tmp_path / "without")
    done("tables", recording, "--elevation", learned[0], "--out", tmp_path / "with")
    with_map, no_map = (pd.read_parquet(tmp_path / name / "rides.parquet") for name in ("with", "without"))
    assert (with_map["gained_m"] != no_map["gained_m"]).all()
    assert (with_map["distance_km"] == no_map["distance_km"]).all()
    quality = json.loads((tmp_path / "with" / "quality.json").read_text())
    assert quality["elevation_map"]["fixes"] > 590
    assert "elevation_map" not in json.loads((tmp_path / "without" / "quality.json").read_text())


def test_fixes_outside_are_one_line(recording, tmp_path):
    pytest.importorskip("rasterio")
    tile = srtm_of_hills(tmp_path / "N45W074.hgt")
    elsewhere = tile.rename(tmp_path / "N10E010.hgt")
    _, err, code = called("tables", recording, "--elevation", elsewhere, "--out", tmp_path / "tables")
    assert code == 0
    assert err.count("lie outside the maps of --elevation") == 1
    assert "in N45W074" in err


def test_replay_takes_a_map_and_publishing_refuses_it(recording, learned, capsys):
    done("replay", recording, "--elevation", learned[0])
    capsys.readouterr()
    message = refused(capsys, "replay", recording, "--elevation", learned[0], "--connect", "tcp/127.0.0.1:1")
    assert "--elevation" in message


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["-o", "map.csv"], "a map of elevation ends in .parquet; name it map.parquet"),
        (["-o", "no/such/map.parquet"], "cannot be written"),
    ],
)
def test_wrong_output_is_refused_before_reading(recording, arguments, words, capsys):
    assert words in refused(capsys, "elevation", "learn", recording, *arguments)


@pytest.mark.parametrize("messages", [[], [Message("fleet/a/door", b"open", BEGIN)]])
def test_recording_without_a_usable_message_is_refused(messages, tmp_path, capsys):
    path = write_recording(tmp_path / "empty.mcap", messages)
    message = refused(capsys, "elevation", "learn", path, "-o", tmp_path / "map.parquet")
    assert f"{path}: no message that socast can read; record telemetry under fleet/VEHICLE/telemetry" in message


def test_recording_without_a_position_is_refused_with_the_number_of_fixes(tmp_path, capsys):
    path = write_recording(tmp_path / "blind.mcap", make_telemetry(120))
    message = refused(capsys, "elevation", "learn", path, "-o", tmp_path / "map.parquet")
    assert "0 usable fixes with an elevation, and a map takes 100: give recordings of cars that drive" in message


def test_recording_without_elevation_is_refused(tmp_path, capsys):
    path = tmp_path / "flat.mcap"
    write_recording(path, telemetry(without(hilly_drive(120), "truth", "elevation_m")))
    assert "give recordings of cars that drive and send elevation_m" in refused(
        capsys, "elevation", "learn", path, "-o", tmp_path / "map.parquet"
    )
