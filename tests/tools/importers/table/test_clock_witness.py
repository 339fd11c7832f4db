"""Test that other clocks, names of files and further rows decide about zone, weeks, and the order of day and month."""

import os
import re

import numpy as np
import pandas as pd
import pytest

from tests.support.commands import called
from tests.support.own_tables import make_drive, read_samples, torque

DRIVE = make_drive(300, start=1714989600.0)  # 6 May 2024, 10:00 UTC
UTC = DRIVE["stamp"]
LOCAL = UTC + pd.Timedelta(hours=2)
SPEED = {"speed_kmh": (DRIVE["speed"] * 3.6).round(2)}


def import_guessed(path, columns, **options):
    """Import a table with a guessed map; return the times of its samples, what was printed, and the map."""
    pd.DataFrame(columns | SPEED).to_csv(path, index=False)
    return import_files([path], **options)


def import_files(paths, preset=None):
    """Import files with a guessed map; return the times of their samples, what was printed, and the map."""
    out, map_file = paths[0].with_suffix(".mcap"), paths[0].with_suffix(".toml")
    how = ["--guess"] if preset is None else ["--preset", preset]
    printed, errors, code = called("import", "csv", *paths, *how, "--map", map_file, "-o", out)
    assert code == 0, errors
    return np.array([each.time_s for each in read_samples(out)]), printed, map_file.read_text(encoding="utf-8")


def assert_true(times):
    """Check that times are those of the drive."""
    assert times == pytest.approx(DRIVE["time"], abs=1.0)


def test_column_in_utc_is_taken_before_one_in_local_time(tmp_path):
    local, utc = LOCAL.strftime("%Y-%m-%d %H:%M:%S"), UTC.strftime("%Y-%m-%d %H:%M:%S")
    times, _, text = import_guessed(tmp_path / "a.csv", {"time": local, "time_utc": utc})
    assert_true(times)
    assert "it is in UTC, beside the local time in column 'time'" in text


def test_offset_stated_at_the_end_of_other_times_is_used(tmp_path):
    gps = pd.Series(LOCAL.strftime("%a %b %d %H:%M:%S GMT+02:00 %Y"))
    gps[::3] = ""  # no fix in a third of the rows
    device = LOCAL.strftime("%d-%b-%Y %H:%M:%S.%f")
    times, _, text = import_guessed(tmp_path / "a.csv", {"Device Time": device, "GPS Time": gps})
    assert_true(times)
    assert 'offset_column = "GPS Time"' in text
    assert "zone" not in text


@pytest.mark.parametrize("month", ["ago.", "août", "Aug", "SIE"])
def test_torque_in_any_language_takes_the_offset_of_gps_time(tmp_path, month):
    text = torque(tmp_path / "a.csv").read_text(encoding="utf-8")
    device = re.compile(r"01-May-2024", re.IGNORECASE)
    assert device.search(text)
    text = device.sub(f"01-{month}-2024", text).replace("May 01", "Aug 01")
    (tmp_path / "a.csv").write_text(text, encoding="utf-8")
    times, printed, _ = import_files([tmp_path / "a.csv"], "torque")
    assert times[0] == pytest.approx(pd.Timestamp("2024-08-01T14:00:00Z").timestamp(), abs=3)
    assert "correct zone" not in printed


@pytest.mark.parametrize("offsets", ["+02:00", "GMT+2", 2, 120, 7200, "CEST", "Europe/Berlin"])
def test_column_of_offsets_is_used(tmp_path, offsets):
    local = LOCAL.strftime("%d.%m.%Y %H:%M:%S")
    times, _, text = import_guessed(tmp_path / "a.csv", {"time": local, "utc_offset": offsets})
    assert_true(times)
    assert 'offset_column = "utc_offset"' in text


def test_offset_may_change_between_rows(tmp_path):
    offsets = np.where(np.arange(300) < 150, "+02:00", "+01:00")
    local = [stamp + pd.Timedelta(hours=2 - (row >= 150)) for row, stamp in enumerate(UTC)]
    columns = {"time": pd.Series(local).dt.strftime("%Y-%m-%d %H:%M:%S"), "offset": offsets}
    assert_true(import_guessed(tmp_path / "a.csv", columns)[0])


def test_zone_follows_from_the_difference_to_sparse_unix_time(tmp_path):
    unix = pd.Series(DRIVE["time"]).astype("Int64")
    unix[np.arange(300) % 10 > 0] = pd.NA
    columns = {"time": LOCAL.strftime("%Y-%m-%d %H:%M:%S"), "gps time": unix}
    times, _, text = import_guessed(tmp_path / "a.csv", columns)
    assert_true(times)
    assert 'zone = "+02:00"' in text


def test_seconds_of_gps_beside_local_time_are_utc(tmp_path):
    columns = {"date": LOCAL.strftime("%Y-%m-%d %H:%M:%S"), "gps_time_s": DRIVE["time"] - 315964800 + 18}
    times, _, text = import_guessed(tmp_path / "a.csv", columns)
    assert_true(times)
    assert "seconds of GPS since 1980, as column 'date' shows" in text


@pytest.mark.parametrize("other", ["phone_time", None])
def test_weeks_of_a_rollover_are_added_where_another_clock_or_the_name_proves_them(tmp_path, other):
    early = (UTC - pd.Timedelta(weeks=1024)).strftime("%Y-%m-%d %H:%M:%SZ")
    columns = {"gps_time": early} | ({other: LOCAL.strftime("%d-%m-%Y %H:%M:%S")} if other else {})
    name = "a.csv" if other else "log 2024-05-06.csv"
    times, printed, text = import_guessed(tmp_path / name, columns)
    assert_true(times)
    assert "add_weeks = 1024" in text
    assert "1024 weeks added" in printed


def test_rollover_without_proof_is_one_line_with_the_remedy(tmp_path):
    early = (UTC - pd.Timedelta(weeks=1024)).strftime("%Y-%m-%d %H:%M:%SZ")
    times, printed, _ = import_guessed(tmp_path / "a.csv", {"time": early})
    assert times == pytest.approx(DRIVE["time"] - 1024 * 604800)
    (line,) = [line for line in printed.splitlines() if "clock against GPS weeks" in line]
    assert "if GPS weeks started again, it was 2024-05-06: set add_weeks = 1024 in [time]" in line


def test_order_of_day_and_month_that_nothing_decides_is_told_as_ambiguous(tmp_path):
    times, printed, text = import_guessed(tmp_path / "a.csv", {"time": UTC.strftime("%d/%m/%Y %H:%M:%S")})
    assert_true(times)
    (line,) = [line for line in printed.splitlines() if line.startswith("ambiguous")]
    assert "may be 2024-05-06 or 2024-06-05, and no row decides; day first is assumed" in line
    assert 'set format = "%m/%d/%Y %H:%M:%S" in [time]' in line
    assert "shorter span" not in text


def test_month_is_assumed_first_beside_miles(tmp_path):
    path = tmp_path / "a.csv"
    pd.DataFrame({"time": UTC.strftime("%m/%d/%Y %H:%M:%S"), "speed (mph)": 30.0}).to_csv(path, index=False)
    times, printed, _ = import_files([path])
    assert_true(times)
    assert "month first is assumed, as with miles and a clock of twelve hours" in printed


DAY_FIRST, MONTH_FIRST = "%d/%m/%Y %H:%M:%S", "%m/%d/%Y %H:%M:%S"


@pytest.mark.parametrize(
    ("witness", "form"),
    [
        *((witness, form) for witness in ("name", "clock", "later row") for form in (DAY_FIRST, MONTH_FIRST)),
        ("age of the file", DAY_FIRST),
    ],
)
def test_witness_decides_the_order_of_day_and_month(tmp_path, witness, form):
    path = tmp_path / ("log-2024-05-06.csv" if witness == "name" else "a.csv")
    columns = {"time": UTC.strftime(form)}
    if witness == "clock":
        columns["device time"] = LOCAL.strftime("%d-%b-%Y %H:%M:%S")
    frame = pd.DataFrame(columns | SPEED)
    if witness == "later row":
        later = frame.copy()
        later["time"] = (UTC + pd.Timedelta(days=20)).strftime(form)
        frame = pd.concat([*[frame] * 300, later])  # beyond the rows from which the map is guessed
    frame.to_csv(path, index=False)
    if witness == "age of the file":
        os.utime(path, (DRIVE["time"][-1] + 60,) * 2)
    _, printed, text = import_files([path])
    assert f'format = "{form}"' in text
    assert "ambiguous" not in printed


def test_day_above_12_in_another_file_decides(tmp_path):
    for name, days in (("a.csv", 0), ("b.csv", 20)):
        stamps = (UTC + pd.Timedelta(days=days)).strftime("%m/%d/%Y %H:%M:%S")
        pd.DataFrame({"time": stamps} | SPEED).to_csv(tmp_path / name, index=False)
    _, printed, text = import_files([tmp_path / "a.csv", tmp_path / "b.csv"])
    assert 'format = "%m/%d/%Y %H:%M:%S"' in text
    assert "ambiguous" not in printed


def test_months_by_name_in_the_names_of_files_start_the_clock(tmp_path):
    columns = {"time (s)": DRIVE["time"] - DRIVE["time"][0]}
    times, _, text = import_guessed(tmp_path / "trackLog-2024-mayo-06_10-00-00.csv", columns)
    assert_true(times)
    assert 'origin_from_file_name = "%Y-%b-%d_%H-%M-%S"' in text


def test_fixed_offset_is_a_zone_of_a_map(tmp_path):
    path, map_file = tmp_path / "a.csv", tmp_path / "map.toml"
    pd.DataFrame({"time": LOCAL.strftime("%Y-%m-%d %H:%M:%S")} | SPEED).to_csv(path, index=False)
    map_file.write_text(
        '[vehicle]\nname = "a"\n[time]\ncolumn = "time"\nzone = "UTC+02:00"\n'
        '[fields]\nspeed_kmh = { column = "speed_kmh" }'
    )
    _, errors, code = called("import", "csv", path, "--map", map_file, "-o", tmp_path / "a.mcap")
    assert code == 0, errors
    assert_true(np.array([each.time_s for each in read_samples(tmp_path / "a.mcap")]))
