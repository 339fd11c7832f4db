"""Test that a wrong unit, sign, zone, decimal mark, header or byte order is found, or is one clear line.

The faults are planted in exports of five products, as `tests.support.own_tables` writes them.
"""

import re

import pytest

from tests.support import own_tables
from tests.support.commands import called

pytestmark = pytest.mark.long
EXPORTS = {
    "teslamate": own_tables.teslamate,
    "leafspy": own_tables.leafspy,
    "abrp": own_tables.abrp,
    "ovms": own_tables.ovms,
    "torque": own_tables.torque,
}


@pytest.fixture(params=EXPORTS)
def export(request, tmp_path):
    """Return the file of an export, and the map that is guessed for it."""
    file, map_file = EXPORTS[request.param](tmp_path / "car.csv"), tmp_path / "map.toml"
    _, errors, code = called("import", "csv", file, "--guess", "--map", map_file)
    assert code == 0, errors
    return file, map_file


def change(path, pattern, by):
    """Replace what a pattern finds in a file, and check that it is there."""
    text, count = re.subn(pattern, by, path.read_text(encoding="utf-8"), flags=re.MULTILINE)
    assert count
    path.write_text(text, encoding="utf-8")


def import_with(file, map_file):
    """Return what an import prints."""
    printed, errors, code = called("import", "csv", file, "--map", map_file, "-o", file.with_suffix(".mcap"))
    assert code == 0, errors
    return printed


def test_export_as_it_is_agrees(export):
    assert "does not agree" not in import_with(*export)


def test_wrong_unit_of_speed_is_found_with_its_remedy(export):
    file, map_file = export
    change(map_file, r'^(speed_kmh = .*unit = )"km/h"', r'\1"m/s"')
    assert "the speed is probably in km/h, not m/s; correct the unit in [fields]" in import_with(file, map_file)


def test_wrong_sign_is_found_with_its_remedy(export):
    file, map_file = export
    change(map_file, r"sign = 1", "sign = -1")
    printed = import_with(file, map_file)
    assert "acceleration charges the battery: invert the sign of the current or the power in [fields]" in printed


def test_wrong_unit_of_power_is_found(export):
    file, map_file = export
    change(map_file, r'^(battery_(?:power_kw|current_a) = .*unit = )"(kW|A)"', r'\1"k\2"')
    text = map_file.read_text(encoding="utf-8").replace("kkW", "MW")
    map_file.write_text(text, encoding="utf-8")
    assert "energy per km" in "".join(line for line in import_with(file, map_file).splitlines() if "not agree" in line)


def test_fraction_taken_for_percent_is_found_with_its_remedy(export):
    file, map_file = export
    change(map_file, r'^(soc_pct = .*unit = )"(%|ppm)"', r'\1"1"')
    lines = [line for line in import_with(file, map_file).splitlines() if "energy against charge" in line]
    assert any("does not agree" in line and "check the units of power and charge" in line for line in lines)


def test_wrong_zone_is_found_by_the_sun_where_times_are_local(tmp_path):
    for name in ("torque", "teslafi"):
        file = getattr(own_tables, name)(tmp_path / f"{name}.csv")
        map_file = tmp_path / f"{name}.toml"
        called("import", "csv", file, "--guess", "--map", map_file)
        assert "agrees: clock against sun" in import_with(file, map_file)
        change(map_file, r'^(zone = "UTC"|offset_column = .*)', 'zone = "Asia/Tokyo"')
        assert "clock against sun: 100%" in (printed := import_with(file, map_file))
        assert "set zone in [time], unless the cars drive at night" in printed


def test_byte_order_mark_and_semicolons_with_decimal_commas_change_nothing(export):
    file, map_file = export
    before = import_with(file, map_file)
    rows = [line.split(",") for line in file.read_text(encoding="utf-8").splitlines()]
    rows = [[re.sub(r"^(-?\d+)\.(\d+)$", r"\1,\2", cell) for cell in row] for row in rows]
    file.write_text("\ufeff" + "\n".join(map(";".join, rows)) + "\n", encoding="utf-8")
    after = import_with(file, map_file)
    assert after.splitlines()[:-1] == before.splitlines()[:-1]
    assert after.count("agrees:") >= 4


def test_duplicate_header_is_one_line(export):
    file, map_file = export
    first = file.read_text(encoding="utf-8").partition("\n")[0]
    name = next(each for each in first.split(",") if each.strip().lower().startswith(("speed", "v.p.speed")))
    lines = file.read_text(encoding="utf-8").splitlines()
    file.write_text("\n".join([f"{lines[0]},{name}", *(f"{line},1" for line in lines[1:])]), encoding="utf-8")
    _, errors, code = called("import", "csv", file, "--map", map_file, "-o", file.with_suffix(".mcap"))
    assert (code, errors.count("\n")) == (2, 1)
    assert f"column '{name.strip()}' appears 2 times; write {name.strip()}#1 or {name.strip()}#2 in the map" in errors
