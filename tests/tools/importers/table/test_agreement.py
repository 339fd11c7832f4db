"""Test that wrong units, signs and zones are found, each with its remedy."""

import numpy as np
import pytest

from socast.tools.importers.table.agreement import check_agreement
from socast.tools.importers.table.agreement_sums import AgreementSums
from tests.support.own_tables import make_drive


def make_rows(start=None, **factors):
    """Return the rows of the drive, with fields multiplied by factors."""
    d = make_drive() if start is None else make_drive(start=start)
    fields = {
        "time": d["time"],
        "vehicle": np.zeros(len(d["time"]), "i4"),
        "speed_kmh": d["speed"] * 3.6,
        "odometer_km": d["distance"] / 1000,
        "battery_voltage_v": np.full(len(d["time"]), 360.0),
        "battery_current_a": d["power"] / 360,
        "soc_pct": d["soc"],
        "latitude_deg": d["latitude"],
        "longitude_deg": d["longitude"],
    }
    rows = np.zeros(len(d["time"]), [(name, values.dtype) for name, values in fields.items()])
    for name, values in fields.items():
        rows[name] = values * factors.get(name, 1)
    return rows


def check(rows, model="nissan-leaf-2013", window=None, *, is_zone_assumed=False):
    """Return the checks by their names."""
    sums = AgreementSums()
    for at in range(0, len(rows), window or len(rows)):
        sums.add(rows[at : at + (window or len(rows))])
    checks = check_agreement(sums.list_cars(["a"], {}, model), is_zone_assumed=is_zone_assumed)
    return {each.name: each for each in checks}


def test_right_data_agree():
    checks = check(make_rows(), model=None)
    assert all(each.passed for each in checks.values()), checks
    assert "40 kWh per 100 %" in checks["energy against charge"].found


def test_division_into_windows_changes_no_verdict():
    rows = make_rows()
    found, expected = check(rows, window=17), check(rows)
    assert {name: each.found for name, each in found.items()} == {name: each.found for name, each in expected.items()}


@pytest.mark.parametrize(
    ("factors", "name", "remedy"),
    [
        ({"speed_kmh": 1 / 1.609344}, "odometer against speed", "speed is probably in mph"),
        ({"speed_kmh": 1 / 1.609344}, "positions against speed", "speed is probably in mph"),
        ({"speed_kmh": 1 / 3.6}, "positions against speed", "speed is probably in m/s"),
        ({"odometer_km": 1 / 1.609344}, "odometer against speed", "odometer is probably in miles"),
        ({"battery_current_a": -1}, "power of acceleration", "invert the sign"),
        ({"battery_current_a": -1}, "energy per km", "invert it in [fields]"),
        ({"battery_current_a": -1}, "energy against charge", "invert the sign"),
        ({"battery_current_a": 1000}, "energy per km", "check the units of power"),
        ({"soc_pct": 20}, "energy against charge", "check the units of power and charge"),
        ({"soc_pct": 0.01}, "energy against charge", "if it is a fraction, set unit = '1'"),
        ({"soc_pct": 0.0}, "energy against charge", "the charge hardly changes"),
    ],
)
def test_wrong_unit_or_sign_is_found_with_its_remedy(factors, name, remedy):
    found = check(make_rows(**factors))[name]
    assert found.passed is False
    assert remedy in found.remedy


def test_capacity_is_compared_with_the_catalogue():
    found = check(make_rows())["energy against charge"]
    assert (found.passed, found.limit) == (False, "60 to 115 %")
    assert found.found.startswith("167% of the nominal capacity")


def test_wrong_zone_makes_cars_drive_at_night():
    found = check(make_rows(start=1714572000.0 - 6 * 3600))["clock against sun"]
    assert found.passed is False
    assert "set zone in [time]" in found.remedy


def test_data_that_are_missing_are_not_checked():
    rows = make_rows()[["time", "vehicle", "speed_kmh"]]
    assert {each.passed for each in check(rows).values()} == {None}


def test_a_third_of_the_driving_at_night_is_told_where_the_zone_was_assumed():
    # by the clock the drives begin at 14, 16 and 20 h, which is 19, 21 and 1 h of solar time at 76.4 degrees east
    parts = [make_rows(start=1714572000.0 + hour * 3600.0) for hour in (0.0, 2.0, 6.0)]
    rows = np.concatenate(parts)
    rows["longitude_deg"] = 76.4
    found = check(rows, is_zone_assumed=True)["clock against sun"]
    assert found.passed is False
    assert found.found == "33%, and 0% with local time"
    assert "set zone = '+05:00'" in found.remedy
    assert check(rows)["clock against sun"].passed
