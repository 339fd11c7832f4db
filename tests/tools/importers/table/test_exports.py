"""Test that exports of known forms are imported by `--guess` without an edited line.

The files are written by `tests.support.own_tables` to the documented forms; they are no copies of real exports.
"""

import numpy as np
import pandas as pd
import pytest

from socast.tools.importers.table.presets import load_presets
from socast.tools.importers.table.units import FIELD_UNITS, convertible
from tests.support import own_tables
from tests.support.commands import called
from tests.support.own_tables import make_drive, read_samples
from tests.support.paths import ROOT

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


EXPORTS = {
    "teslamate": own_tables.teslamate,
    "teslafi": own_tables.teslafi,
    "abrp": own_tables.abrp,
    "ovms": own_tables.ovms,
    "leafspy": own_tables.leafspy,
    "torque": own_tables.torque,
    "car-scanner": own_tables.car_scanner,
    "car-scanner-long": own_tables.car_scanner_long,
    "vss": own_tables.vss,
    "tesla-fleet-telemetry": own_tables.tesla_fleet_telemetry,
    "geotab": None,
}


def write_export(name, folder):
    """Write the files of an export; the name of the file holds the day, as that of Car Scanner does."""
    write = EXPORTS[name]
    return own_tables.geotab(folder) if write is None else [write(folder / "2024-05-01 14-00-00.csv")]


@pytest.mark.parametrize("name", EXPORTS)
def test_preset_is_found_by_the_columns_and_gives_the_drive_in_si_units(tmp_path, name):
    samples, printed, map_text = import_guessed(tmp_path, *write_export(name, tmp_path))
    assert f"preset {name}: the columns are those of" in printed
    assert f"(preset {name})" in map_text
    assert "does not agree" not in printed
    times = column(samples, "time_s")
    assert (times[0], times[-1]) == pytest.approx((DRIVE["time"][0], DRIVE["time"][-1]), abs=2)
    known = np.array([each.speed_kmh is not None and each.battery_current_a is not None for each in samples])
    assert known.mean() > 0.99
    speed = np.array([each.speed_kmh for each in samples])[known].astype(float)
    measured = np.array([each.battery_voltage_v * each.battery_current_a for each in np.array(samples)[known]])
    assert speed == pytest.approx(np.interp(times[known], DRIVE["time"], DRIVE["speed"]) * 3.6, abs=8)
    assert speed.mean() == pytest.approx(DRIVE["speed"].mean() * 3.6, rel=0.01)
    assert measured.mean() == pytest.approx(DRIVE["power"].mean(), rel=0.02)
    assert column(samples, "soc_pct")[[0, -1]] == pytest.approx(DRIVE["soc"][[0, -1]], abs=0.6)
    assert column(samples, "ambient_c") == pytest.approx(12, abs=0.01)


@pytest.mark.parametrize("name", EXPORTS)
def test_preset_imports_without_a_map(tmp_path, name):
    out = tmp_path / "out.mcap"
    printed, errors, code = called("import", "csv", *write_export(name, tmp_path), "--preset", name, "-o", out)
    assert code == 0, errors
    assert "agrees: energy per km" in printed
    assert "the map is not kept" in printed


def test_every_preset_is_tested_and_names_its_source():
    presets = load_presets()
    assert presets.keys() == EXPORTS.keys()
    for preset in presets.values():
        assert preset.title
        assert len(preset.source) > 40
        assert preset.how
        assert set(preset.fields) <= set(FIELD_UNITS)
        units = {place.unit for places in preset.fields.values() for place in places if place.unit}
        assert all(any(convertible(unit, field) for field in preset.fields) for unit in units)


def test_other_table_is_refused_by_a_preset_in_one_line(tmp_path):
    file = own_tables.abrp(tmp_path / "car.csv")
    _, errors, code = called("import", "csv", file, "--preset", "leafspy", "-o", tmp_path / "a.mcap")
    assert (code, errors.count("\n")) == (2, 1)
    assert "lacks Pack Volts, Pack Amps, Gids of LeafSpy Pro; it has utc, soc" in errors
    _, errors, _ = called("import", "csv", file, "--preset", "leaf", "-o", tmp_path / "a.mcap")
    assert "--preset is 'leaf', must be one of abrp, car-scanner" in errors


def test_sign_of_the_preset_is_inverted_where_the_drive_says_otherwise(tmp_path):
    file = own_tables.vss(tmp_path / "car.csv")
    frame = pd.read_csv(file)
    for name in frame.columns[frame.columns.str.contains("CurrentCurrent|CurrentPower")]:
        frame[name] = -frame[name]
    frame.to_csv(file, index=False)
    samples, _, map_text = import_guessed(tmp_path, file)
    assert power(samples) == pytest.approx(DRIVE["power"], abs=4)
    assert map_text.count("sign inverted against the preset") == 2


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


def test_charging_current_of_wrong_sign_is_inverted_and_said_so(tmp_path):
    samples, printed, map_text = import_guessed(tmp_path, own_tables.abrp(tmp_path / "car.csv", sign=-1))
    assert power(samples) == pytest.approx(DRIVE["power"], abs=4)
    for field in ("battery_current_a", "battery_power_kw"):
        (line,) = [line for line in map_text.splitlines() if line.startswith(field)]
        assert "sign = -1" in line
        assert "sign inverted against the preset: with its sign, acceleration would charge the battery" in line
    assert "sign inverted" in printed


def test_guessed_map_never_overwrites_a_map(tmp_path):
    (tmp_path / "map.toml").write_text("mine")
    file = own_tables.abrp(tmp_path / "car.csv")
    _, errors, code = called("import", "csv", file, "--guess", "--map", tmp_path / "map.toml")
    assert (code, (tmp_path / "map.toml").read_text()) == (2, "mine")
    assert "is there already" in errors


def test_guide_lists_every_preset():
    guide = (ROOT / "docs" / "guide" / "import.md").read_text(encoding="utf-8")
    for preset in load_presets().values():
        assert f"| `{preset.name}` | {preset.title} | {preset.how} |" in guide
