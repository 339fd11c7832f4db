"""Test the location of an error on synthetic drives with planted loads."""

import json
from functools import cache

import numpy as np
import pandas as pd
import pytest

from socast.core.diagnose.error_location.kinds import KINDS, gather_kinds
from socast.core.diagnose.error_location.locate import locate_error
from socast.core.diagnose.error_location.location_model import get_drivers
from tests.support.synthetic_windows import gather_with_model, make_tables, make_windows, project_base

pytestmark = pytest.mark.long

NOISE = 0.004
ENERGIES = {kind.name: kind.energy for kind in KINDS}


def locate(table, unknown=0.0, drivers=None, **errors):
    """Return the location of the error of drives with unknown energies."""
    rides, windows = make_tables(table, unknown=unknown, noise=NOISE, **errors)
    if drivers is not None:
        rides = rides.assign(driver_id=drivers)
    base = project_base((rides, windows))
    return locate_error(base.windows, base)


def plant(table, level, kind, size, seed=3):
    """Return the energy of a load of its own of each unit of a level. [kWh]"""
    names = {
        "ride": table["ride_key"],
        "day": table["vehicle_id"] + " " + table["date"],
        "date": table["date"],
        "car": table["vehicle_id"],
    }
    unit = pd.factorize(names[level])[0]
    deviates = np.random.default_rng(seed).normal(0.0, 1.0, unit.max() + 1)
    deviates /= np.std(deviates)
    return size * deviates[unit] * ENERGIES[kind](table)


@cache
def locate_planted(level, kind, size):
    """Return the location of the error of drives with one load."""
    return locate(make_windows(), plant(make_windows(), level, kind, size))


def names(location):
    return {(load.level, load.kind) for load in location.loads}


def test_nothing_is_claimed_where_nothing_is_hidden():
    location = locate(make_windows())
    assert location.loads == ()
    assert sum(location.shares.values()) == pytest.approx(1.0)
    assert location.shares["measurement"] + location.shares["scatter"] == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("level", "kind", "size"),
    [
        ("ride", "constant", 0.4),
        ("ride", "beginning", 2.0),
        ("day", "constant", 0.4),
        ("day", "rolling", 0.3),
        ("day", "drag", 0.4),
        ("ride", "climbing", 0.5),
        ("ride", "braking", 0.4),
    ],
)
def test_planted_load_is_located_with_its_size(level, kind, size):
    location = locate_planted(level, kind, size)
    assert names(location) == {(level, kind)}
    (load,) = location.loads
    planted = size * (1000.0 if load.unit == "W" else 100.0)
    assert load.low < planted < load.high
    assert load.size == pytest.approx(planted, rel=0.25)
    assert location.shares[level] == max(location.shares.values())


def test_two_loads_are_located_at_once():
    table = make_windows()
    both = plant(table, "ride", "constant", 0.4) + plant(table, "day", "drag", 0.5, seed=5)
    assert names(locate(table, both)) == {("ride", "constant"), ("day", "drag")}


def test_load_of_dates_is_told_from_that_of_vehicle_days():
    table = make_windows()
    location = locate(table, plant(table, "date", "constant", 0.4))
    assert names(location) == {("date", "constant")}
    (load,) = location.loads
    assert load.low < 400.0 < load.high


def test_load_of_drivers_is_told_from_that_of_vehicle_days():
    table = make_windows(days=30)
    rides, _ = make_tables(table)
    day = pd.factorize(rides["vehicle_id"] + " " + rides["date"])[0]
    driver = np.random.default_rng(4).integers(0, 20, day.max() + 1)[day]
    of_window = pd.Series(driver, index=rides["ride_key"]).loc[table["ride_key"]].to_numpy()
    load = 0.4 * np.random.default_rng(6).normal(size=20)[of_window] * ENERGIES["constant"](table)
    location = locate(table, load, drivers=[f"driver {number}" for number in driver])
    assert names(location) == {("driver", "constant")}
    assert "driver" not in location.absent_signals


def test_shape_that_is_smooth_in_temperature_is_not_located():
    table = make_windows()
    curve = 1.5 * np.tanh((table["ambient_c"].to_numpy() - 5.0) / 8.0) * ENERGIES["constant"](table)
    assert locate(table, curve).loads == ()


def test_rides_of_one_window_are_not_told_from_windows():
    table = make_windows(rides=6, windows=1)
    assert "ride" not in locate(table).levels


def test_kinds_without_energy_and_absent_signals_are_listed():
    table = make_windows().assign(effect_climbing_up=0.0, effect_climbing=0.0, wind_speed_kmh=np.nan)
    location = locate(table)
    assert location.absent_kinds == ("climbing",)
    assert {"elevation", "wind", "driver"} <= set(location.absent_signals)
    assert "outside temperature" not in location.absent_signals


def test_location_is_plain_json():
    plain = locate_planted("ride", "constant", 0.4).to_json()
    assert json.loads(json.dumps(plain)) == plain
    assert plain["loads"][0]["kind"] == "constant"
    assert len(plain["estimates"]) >= 12


def test_kinds_have_a_mean_power_of_a_kilowatt():
    windows = gather_with_model(make_tables(make_windows()))[0]
    kinds = gather_kinds(windows.table)
    hours = windows.table["duration_s"].sum() / 3600.0
    np.testing.assert_allclose(kinds.columns.sum(axis=0) / hours, 1.0)


def test_drivers_are_unknown_where_a_vehicle_day_has_two():
    rides, windows = make_tables(make_windows())
    seen = gather_with_model((rides.assign(driver_id=[f"d{i % 2}" for i in range(len(rides))]), windows))[0]
    assert get_drivers(seen) is None
