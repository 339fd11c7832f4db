"""Test golden files."""

import json

import pandas as pd
import pytest

from socast.core.errors import RecordingError, SettingsError
from socast.core.wire.messages import Message
from socast.stream.mcap_writer import McapSink
from socast.tools.testing.golden_files import check_forecasts, check_table, compare_recordings

FORECAST = {"time_s": 1.5e9, "model": "m/1", "soc_pct": 80.0, "range_km": {"mean": 100.0, "p05": None}, "ride_id": None}
TABLE = pd.DataFrame(
    {
        "vehicle_id": ["007", "008", "009"],
        "start_s": [1.0 / 3.0, 2.0, 3.0],
        "energy_kwh": [0.1 + 0.2, None, 1e-300],
        "stops": [1, 2, 3],
        "fit": [True, False, True],
        "reason": ["", None, 'a, "quoted"\nline'],
        "nothing": [None, None, None],
        "at": pd.to_datetime(["2024-01-01T00:00:00.123456Z", None, "2024-01-02"], format="ISO8601", utc=True),
    }
)


@pytest.fixture
def write(tmp_path):
    """Return a function that writes forecasts of cars, each given by the fields that differ."""

    def write(name, *forecasts):
        with McapSink(tmp_path / name) as sink:
            for i, (vehicle, changes) in enumerate(forecasts):
                payload = FORECAST | {"vehicle_id": vehicle, "time_s": FORECAST["time_s"] + i} | changes
                sink.put([Message(f"fleet/{vehicle}/forecast", json.dumps(payload).encode(), i)])
        return tmp_path / name

    return write


def check(file, table, *, update=False, **options):
    return check_table(
        file, table, key=options.pop("key", ()), tolerances=options.pop("tolerances", None), update=update
    )


def test_forecasts_of_recordings_are_compared(write):
    expected = write("x", ("a", {}), ("b", {}))
    assert compare_recordings(expected, write("y", ("a", {}), ("b", {}))).is_equal
    comparison = compare_recordings(expected, write("z", ("a", {"range_km": {"mean": 99.0}}), ("c", {})))
    assert [each.field for each in comparison.differences] == ["range_km.mean"]
    assert [*comparison.missing, *comparison.additional] == ["b", "c"]


def test_field_that_no_forecast_has_yet_may_have_a_tolerance(write):
    file = write("x", ("a", {}))
    assert compare_recordings(file, file, {"next_charge": 1.0}).is_equal


def test_expectation_that_breaks_off_is_refused(write):
    file = write("x.mcap", *[("a", {"note": "y" * 2000 + str(i)}) for i in range(5000)])
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    with pytest.raises(RecordingError, match=r"x.mcap: .* write it anew with pytest --socast-update"):
        compare_recordings(file, file)


def test_expectation_without_forecasts_is_neither_written_nor_compared(tmp_path, write):
    with pytest.raises(SettingsError, match="made no forecasts"):
        check_forecasts(tmp_path / "new.mcap", write("y.mcap"), None, update=True)
    assert not (tmp_path / "new.mcap").exists()


def test_expectation_of_another_recording_is_supposed(write):
    difference = check_forecasts(write("x", ("a", {})), write("y", ("b", {})), None, update=False).difference
    assert "is this the expectation of another recording?" in difference


def test_expectation_without_forecasts_is_refused(write):
    with pytest.raises(RecordingError, match="holds no forecasts"):
        compare_recordings(write("x"), write("y"))


def test_absent_expectation_names_the_option_of_pytest(tmp_path, write):
    found = write("y", ("a", {}))
    expected = tmp_path / "new" / "x.mcap"
    assert "pytest --socast-update" in check_forecasts(expected, found, None, update=False).difference
    assert check_forecasts(expected, found, None, update=True) == ("", f"{expected}: written for the first time")
    assert check_forecasts(expected, found, None, update=False) == ("", "")


def test_update_says_what_changes_and_leaves_no_other_file(tmp_path, write):
    expected = tmp_path / "golden" / "x.mcap"
    check_forecasts(expected, write("y", ("a", {})), None, update=True)
    changed = check_forecasts(expected, write("z", ("a", {"soc_pct": 81.0})), None, update=True).written
    assert "written anew; 1 value of 1 field differs (soc_pct); 1 forecast compared" in changed
    assert "soc_pct [%]" in changed
    assert [path.name for path in expected.parent.iterdir()] == ["x.mcap"]
    assert "1 forecast as before" in check_forecasts(expected, tmp_path / "z", None, update=True).written


def test_damaged_expectation_can_be_updated(tmp_path, write):
    expected = tmp_path / "x.mcap"
    expected.write_bytes(b"no recording")
    assert "could not be compared" in check_forecasts(expected, write("y", ("a", {})), None, update=True).written
    assert check_forecasts(expected, tmp_path / "y", None, update=False) == ("", "")


@pytest.mark.parametrize("name", ["x.csv", "x.parquet"])
def test_tables_come_back_as_they_were(tmp_path, name):
    assert check(tmp_path / name, TABLE, update=True).written.endswith("written for the first time")
    assert check(tmp_path / name, TABLE) == ("", "")
    difference = check(tmp_path / name, TABLE.assign(energy_kwh=TABLE["energy_kwh"] * 1.01)).difference
    assert "energy_kwh [kWh]: differs in 1 of 3 rides" in difference
    assert f"write {tmp_path / name} with pytest --socast-update" in difference


def test_counters_come_back_as_they_were(tmp_path):
    counters = pd.DataFrame({"count": [1, 2]}, index=pd.Index(["gap", "late"], name="counter"))
    check(tmp_path / "x.csv", counters, update=True)
    assert (tmp_path / "x.csv").read_text() == "counter,count\ngap,1\nlate,2\n"
    assert check(tmp_path / "x.csv", counters) == ("", "")
    assert "late" in check(tmp_path / "x.csv", counters.replace(2, 3)).difference


def test_other_file_than_a_table_is_refused(tmp_path):
    with pytest.raises(SettingsError, match=r"x.json: give a name that ends with .csv or .parquet"):
        check(tmp_path / "x.json", TABLE)
    (tmp_path / "x.parquet").write_bytes(b"no table")
    with pytest.raises(SettingsError, match="cannot read a table"):
        check(tmp_path / "x.parquet", TABLE)
