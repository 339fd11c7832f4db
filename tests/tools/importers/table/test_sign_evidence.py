"""Test that right data never get the advice to invert a sign, and that a wrong sign is told, for single cars too."""

import numpy as np
import pandas as pd
import pytest

from socast.tools.importers.table.agreement import check_agreement, judge_sign
from socast.tools.importers.table.agreement_sums import AgreementSums
from socast.tools.importers.table.row_order import sort_rows
from tests.support.commands import called
from tests.support.own_tables import make_drive
from tests.tools.importers.table.test_agreement import make_rows

GRAVITY = 9.81


def sum_cars(rows, names=("a",)):
    """Return the sums of cars."""
    sums = AgreementSums()
    sums.add(rows)
    return sums.list_cars(list(names), {}, None)


def judge(rows):
    """Return what the witnesses say of one car."""
    return judge_sign(sum_cars(rows)[0])


def descend(rows, slope, *, with_elevation=False):
    """Return rows of the drive down a slope, and its charge accordingly."""
    rows = rows.copy()
    fallen = (rows["odometer_km"] - rows["odometer_km"][0]) * 1000.0 * slope
    power = rows["battery_current_a"] * 360.0 - 1600.0 * GRAVITY * slope * rows["speed_kmh"] / 3.6
    rows["battery_current_a"] = power / 360.0
    rows["soc_pct"] = 80.0 - np.cumsum(power) * 2.0 / 3.6e6 / 40.0 * 100.0
    if not with_elevation:
        return rows
    named = np.zeros(len(rows), [*rows.dtype.descr, ("elevation_m", "f8")])
    for name in rows.dtype.names:
        named[name] = rows[name]
    named["elevation_m"] = 1500.0 - fallen
    return named


def charge(rows, power_w, minutes=120.0):
    """Return the drive, a time of charging without a flag, and the drive again."""
    stop = np.repeat(rows[-1:], int(minutes * 6))
    stop["time"] += 10.0 * np.arange(1, len(stop) + 1)
    stop["speed_kmh"] = 0.0
    stop["battery_current_a"] = -power_w / 360.0
    stop["soc_pct"] += np.arange(len(stop)) * 10.0 * power_w / 3.6e6 / 40.0 * 100.0
    after = rows.copy()
    after["time"] += stop["time"][-1] + 10.0 - rows["time"][0]
    after["odometer_km"] += rows["odometer_km"][-1] - rows["odometer_km"][0]
    return np.concatenate([rows, stop, after])


def forget_charge(rows):
    """Return rows without a state of charge."""
    rows = rows.copy()
    rows["soc_pct"] = np.nan
    return rows


RIGHT = {
    "downhill, charge known": descend(make_rows(), 0.05),
    "downhill, elevation known": descend(make_rows(), 0.05, with_elevation=True),
    "downhill, charge unknown": forget_charge(descend(make_rows(), 0.05)),
    "charging at 1.4 kW": charge(make_rows(), 1400.0, 600.0),
    "charging at 11 kW": charge(make_rows(), 11_000.0),
    "charging at 11 kW, charge unknown": forget_charge(charge(make_rows(), 11_000.0)),
}


@pytest.mark.parametrize("name", RIGHT)
def test_right_data_never_get_the_advice_to_invert(name):
    checks = check_agreement(sum_cars(RIGHT[name]))
    assert judge(RIGHT[name]).sign == 1
    assert not [each for each in checks if "invert" in each.remedy + each.found]
    assert not [each for each in checks if each.passed is False], checks


@pytest.mark.parametrize("name", RIGHT)
def test_inverted_data_are_told(name):
    rows = RIGHT[name].copy()
    rows["battery_current_a"] *= -1
    remedies = [each.remedy for each in check_agreement(sum_cars(rows)) if each.passed is False]
    assert judge(rows).sign == -1
    assert any("invert" in remedy for remedy in remedies)


def test_descent_without_any_other_witness_decides_nothing():
    rows = descend(make_rows(), 0.05)[::10]
    rows["soc_pct"] = np.nan
    checks = {each.name: each for each in check_agreement(sum_cars(rows))}
    assert judge(rows).sign == 0
    assert checks["energy per km"].passed is None
    assert "nothing in the file shows which" in checks["energy per km"].found


@pytest.mark.parametrize(("slope", "factor", "sign"), [(0.0, 1, 1), (0.0, -1, -1), (0.05, 1, 0), (-0.05, -1, -1)])
def test_elevation_tells_a_wrong_sign_from_a_descent(slope, factor, sign):
    rows = descend(make_rows(), slope, with_elevation=True)[::10]
    rows["soc_pct"] = np.nan
    rows["battery_current_a"] *= factor
    assert judge(rows).sign == sign


def test_witnesses_that_contradict_each_other_are_named_and_nothing_is_advised():
    rows = make_rows()
    rows["soc_pct"] = 160.0 - rows["soc_pct"]
    evidence = judge(rows)
    assert (evidence.sign, evidence.inverted) == (0, ("charge",))
    assert "acceleration" in evidence.right
    check = {each.name: each for each in check_agreement(sum_cars(rows))}["energy against charge"]
    assert "acceleration and energy per km for this sign, charge against it" in check.remedy
    assert "invert" not in check.remedy


def test_power_that_lags_behind_the_speed_does_not_invert_the_sign():
    rows = make_rows(soc_pct=np.nan)
    rows["battery_current_a"] = np.roll(rows["battery_current_a"], 8)
    assert judge(rows).sign >= 0
    assert not [each for each in check_agreement(sum_cars(rows)) if "invert" in each.remedy]


def test_one_car_with_another_sign_is_named(tmp_path):
    parts = [make_rows() for _ in range(3)]
    for place, part in enumerate(parts):
        part["vehicle"] = place
    parts[1]["battery_current_a"] *= -1
    (rows,) = sort_rows([np.concatenate(parts)], tmp_path)
    checks = {each.name: each for each in check_agreement(sum_cars(rows, ("a", "b", "c")))}
    assert "1 of 3 cars with the opposite sign of current or power: b (acceleration" in checks["sign of each car"].found
    assert "inverted = ['b'] in [vehicle]" in checks["sign of each car"].remedy
    assert [each.name for each in checks.values() if each.passed is False] == ["sign of each car"]


def test_guess_inverts_one_car_alone_and_the_import_agrees(tmp_path):
    d = make_drive()
    frames = [
        pd.DataFrame(
            {
                "time": d["stamp"] + pd.Timedelta(days=car),
                "car": f"taxi-{car}",
                "speed_kmh": (d["speed"] * 3.6).round(2),
                "power_kw": ((-1 if car == 2 else 1) * d["power"] / 1000).round(3),
                "soc": d["soc"].round(1),
            }
        )
        for car in range(3)
    ]
    file = tmp_path / "cars.csv"
    pd.concat(frames).to_csv(file, index=False)
    printed, errors, code = called(
        "import", "csv", file, "--guess", "--map", tmp_path / "m.toml", "-o", tmp_path / "o.mcap"
    )
    assert code == 0, errors
    assert 'inverted = ["taxi-2"]' in (tmp_path / "m.toml").read_text()
    assert "opposite sign" not in printed
    assert "does not agree" not in printed


def test_impossible_speeds_are_named_and_do_not_disturb_the_other_checks():
    rows = make_rows()
    expected = {each.name: each for each in check_agreement(sum_cars(rows))}
    rows["speed_kmh"][[100, 300, 301, 500, 800, 1000]] = [400.0, 655.35, 655.35, 300.0, 500.0, 400.0]
    checks = {each.name: each for each in check_agreement(sum_cars(rows))}
    assert checks["speed"].passed is False
    assert "6 rows with an impossible speed, first 400 km/h of a at 2024-05-01 14:03:20 UTC" in checks["speed"].found
    failed = [each.name for each in checks.values() if each.passed is False]
    assert failed == ["speed"]
    assert checks["power of acceleration"].found == expected["power of acceleration"].found
