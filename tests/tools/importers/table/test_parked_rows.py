"""Test that stops, charging and parking cut rides where an export changes its period, and that a state says so."""

import re
import tomllib

import numpy as np
import pandas as pd
import pytest

from socast.tools.importers.table.conversion import fill_parked
from socast.tools.importers.table.guess_sources import find_charging, find_parked
from socast.tools.importers.table.row_messages import has_period
from tests.support.commands import called
from tests.support.own_tables import KM_PER_MILE, make_drive, read_samples, teslafi


def list_days(parked_every):
    """Return a table of two drives with rows 10 s apart, and the parking and charging before, between and after."""
    d = make_drive(rows=240, step=10.0)
    speed = np.where((np.arange(240) < 2) | (np.arange(240) >= 239), 0.0, d["speed"])
    parts, start, odometer = [], d["stamp"][0], 12000.0
    stands = np.arange(0, 7200, parked_every)
    for ride in range(2):
        parts.append(
            pd.DataFrame(
                {
                    "time": start + pd.to_timedelta(stands, unit="s"),
                    "state": np.where((stands > 1800) & (stands < 5400) & (ride == 1), "charging", "parked"),
                    "power_kw": np.where((stands > 1800) & (stands < 5400) & (ride == 1), -7, 0),
                    "odometer_km": odometer,
                    "soc": 80 if ride == 0 else 75,
                }
            )
        )
        start += pd.Timedelta(seconds=7200)
        parts.append(
            pd.DataFrame(
                {
                    "time": start + pd.to_timedelta(np.arange(240) * 10, unit="s"),
                    "state": "driving",
                    "speed_mph": (speed * 3.6 / KM_PER_MILE).round(1),
                    "power_kw": (d["power"] / 1000).round(2),
                    "odometer_km": (odometer + d["distance"] / 1000).round(2),
                    "soc": d["soc"].round(1),
                }
            )
        )
        start, odometer = start + pd.Timedelta(seconds=2400), odometer + d["distance"][-1] / 1000
    return pd.concat(parts), d["distance"][-1] / 1000


@pytest.mark.parametrize("parked_every", [60, 600])
@pytest.mark.parametrize("has_state", [True, False])
def test_drives_between_parked_rows_are_rides_of_their_own(tmp_path, parked_every, has_state):
    rows, distance_km = list_days(parked_every)
    rows = rows if has_state else rows.drop(columns="state")
    file = tmp_path / "car.csv"
    rows.to_csv(file, index=False)
    words = (
        "--guess",
        "--vehicle-model",
        "nissan-leaf-2013",
        "-o",
        tmp_path / "car.mcap",
        "--map",
        tmp_path / "m.toml",
    )
    printed, errors, code = called("import", "csv", file, *words)
    assert code == 0, errors
    assert "invert" not in printed
    assert tomllib.loads((tmp_path / "m.toml").read_text())["vehicle"]["model"] == "nissan-leaf-2013"
    assert called("tables", tmp_path / "car.mcap", "--out", tmp_path / "t")[2] == 0
    rides = pd.read_parquet(tmp_path / "t" / "rides.parquet")
    rides = rides[rides["distance_km"] > 0.5]
    assert rides["distance_km"].to_numpy() == pytest.approx([distance_km] * 2, rel=0.03)
    if has_state:
        assert rides["fit_for_training"].all()


def test_parked_and_charging_rows_stand_and_the_state_says_charging(tmp_path):
    rows, _ = list_days(60)
    rows.to_csv(tmp_path / "car.csv", index=False)
    called("import", "csv", tmp_path / "car.csv", "--guess", "--map", tmp_path / "m.toml", "-o", tmp_path / "o.mcap")
    text = (tmp_path / "m.toml").read_text()
    assert re.search(r'\[parked\]\ncolumn = "state"\nvalues = \["parked", "charging"\]', text)
    assert "[ride]" not in text
    samples = read_samples(tmp_path / "o.mcap")
    charging = [each for each in samples if each.charging]
    assert charging
    assert {each.speed_kmh for each in charging} == {0.0}


def test_teslafi_rows_without_speed_and_shift_state_are_parked(tmp_path):
    rows = pd.read_csv(teslafi(tmp_path / "fi.csv"), encoding="utf-8-sig").iloc[:100]
    rows = rows.astype({"speed": object, "shift_state": object})
    rows.loc[50:, ["speed", "shift_state"]] = "None"
    rows.loc[60:70, "charging_state"] = "Charging"
    rows.to_csv(tmp_path / "fi.csv", index=False)
    assert called("import", "csv", tmp_path / "fi.csv", "--guess", "-o", tmp_path / "fi.mcap")[2] == 0
    samples = read_samples(tmp_path / "fi.mcap")
    assert {each.speed_kmh for each in samples[50:]} == {0.0}
    assert [at for at, each in enumerate(samples) if each.charging] == list(range(60, 71))


def test_words_of_a_state_are_those_that_say_where_a_car_is():
    assert find_parked(["D", "P", "R"]) == ("P",)
    assert find_parked(["online", "asleep", "offline"]) == ("asleep", "offline")
    assert find_parked(["parked", "Toronto"]) == ()
    assert find_charging(["driving", "charging", "DC charging"]) == ("charging", "DC charging")


def make_rows(*rows):
    """Return rows of time, speed and odometer."""
    made = np.zeros(len(rows), [("time", "f8"), ("vehicle", "i4"), ("speed_kmh", "f8"), ("odometer_km", "f8")])
    for place, (time, speed, odometer) in enumerate(rows):
        made[place] = (time, 0, speed, odometer)
    return made


def test_rows_are_added_only_while_the_car_stands_where_it_was():
    rows = make_rows((0, 0, 5), (600, 0, 5), (660, 30, 5), (1200, 0, 9), (1800, 0, 12), (9000, 0, 12))
    filled = np.concatenate(list(fill_parked([rows])))
    assert filled["time"].tolist() == [*range(0, 601, 60), 660, 1200, 1800, 9000]


def test_division_into_blocks_adds_the_same_rows():
    rows = make_rows(*((300.0 * place, 0, 5) for place in range(40)))
    whole = np.concatenate(list(fill_parked([rows])))
    divided = np.concatenate(list(fill_parked(np.array_split(rows, 7))))
    assert divided.tolist() == whole.tolist()


def test_a_log_that_changes_its_period_has_none():
    assert not has_period(np.append(np.arange(0, 1000, 10.0), np.arange(1000, 9000, 60.0)))
    lost = np.random.default_rng(1).random(1000) > 0.2
    assert has_period(np.arange(1000.0)[lost])
