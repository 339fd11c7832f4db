"""Test that exports of known forms are imported by `--guess` without an edited line."""

import numpy as np
import pytest

from tests.support import own_tables
from tests.support.commands import called
from tests.support.own_tables import make_drive, read_samples

DRIVE = make_drive()


def import_guessed(tmp_path, *files):
    """Import files with a guessed map; return the samples, the output and the map."""
    out, map_file = tmp_path / "out.mcap", tmp_path / "map.toml"
    printed, errors, code = called("import", "csv", *files, "--guess", "--map", map_file, "-o", out)
    assert code == 0, errors
    return read_samples(out), printed, map_file.read_text(encoding="utf-8")


def column(samples, name):
    """Return the known values of a field."""
    return np.array([value for each in samples if (value := getattr(each, name)) is not None])


def power(samples):
    """Return the known powers of samples. [W]"""
    return column(samples, "battery_voltage_v") * column(samples, "battery_current_a")


@pytest.mark.parametrize("write", [own_tables.teslamate, own_tables.abrp, own_tables.ovms])
def test_export_is_imported_as_guessed(tmp_path, write):
    samples, printed, _ = import_guessed(tmp_path, write(tmp_path / "car.csv"))
    assert column(samples, "time_s") == pytest.approx(DRIVE["time"])
    assert column(samples, "speed_kmh") == pytest.approx(DRIVE["speed"] * 3.6, abs=0.51)
    assert column(samples, "odometer_km")[-1] == pytest.approx(12000 + DRIVE["distance"][-1] / 1000, abs=0.1)
    assert column(samples, "soc_pct") == pytest.approx(DRIVE["soc"], abs=0.51)
    assert power(samples) == pytest.approx(DRIVE["power"], abs=501)
    assert column(samples, "ambient_c") == pytest.approx(12)
    assert "does not agree" not in printed
    assert "agrees: energy per km" in printed


def test_geotab_trip_and_status_data_are_joined(tmp_path):
    samples, printed, map_text = import_guessed(tmp_path, *own_tables.geotab(tmp_path))
    assert len(samples) == len(DRIVE["time"])
    assert {each.vehicle_id for each in samples} == {"b28"}
    assert column(samples, "odometer_km") == pytest.approx(12000 + DRIVE["distance"] / 1000, abs=0.01)
    assert column(samples, "soc_pct") == pytest.approx(DRIVE["soc"], abs=0.06)
    assert power(samples) == pytest.approx(DRIVE["power"], abs=1)
    assert 'signal = "DiagnosticOdometerId", unit = "m"' in map_text
    assert "does not agree" not in printed


def test_teslamate_names_rides_by_its_drives(tmp_path):
    samples, *_ = import_guessed(
        tmp_path, own_tables.teslamate(tmp_path / "car.csv", drive_id=[7] * 600 + [None] * 600)
    )
    assert [each.ride_id for each in samples] == ["7"] * 600 + [None] * 600


def test_charging_current_of_wrong_sign_is_turned_and_said_so(tmp_path):
    samples, printed, map_text = import_guessed(tmp_path, own_tables.abrp(tmp_path / "car.csv", sign=-1))
    assert power(samples) == pytest.approx(DRIVE["power"], abs=4)
    for field in ("battery_current_a", "battery_power_kw"):
        (line,) = [line for line in map_text.splitlines() if line.startswith(field)]
        assert "sign = -1" in line
        assert "turned: as it stands, acceleration would charge the battery" in line
    assert "turned" in printed


def test_guessed_map_never_overwrites_a_map(tmp_path):
    (tmp_path / "map.toml").write_text("mine")
    file = own_tables.abrp(tmp_path / "car.csv")
    _, errors, code = called("import", "csv", file, "--guess", "--map", tmp_path / "map.toml")
    assert (code, (tmp_path / "map.toml").read_text()) == (2, "mine")
    assert "is there already" in errors
