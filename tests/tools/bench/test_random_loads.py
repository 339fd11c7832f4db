"""Test that random loads reach the measured energy of the units that they belong to."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from socast.tools.bench.error_location import RandomLoad, measure_with_loads
from socast.tools.bench.hidden import cases
from socast.tools.bench.hidden.cases import Case, SeedData


@pytest.fixture(scope="module")
def source():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cases, "FLEET", replace(cases.FLEET, vehicles=2, days=16, shift_hours=0.8))
        whole = SeedData(5)
        whole.recording("none")
        return whole


def make_tables(source, *loads):
    names = [f"{load.level} {load.kind}" for load in loads]
    return source.recording("none").tables(measure_with_loads(source.drives, loads, 1), "vi", names)


def test_no_load_leaves_tables_as_they_are(source):
    plain = source.tables(Case(5))
    pd.testing.assert_frame_equal(make_tables(source).windows, plain.windows)


@pytest.mark.parametrize("level", ["ride", "day", "driver", "date", "car"])
def test_units_of_a_level_share_a_constant_power(source, level):
    loaded, plain = make_tables(source, RandomLoad(level, "constant", 400.0)), source.tables(Case(5))
    hours = plain.windows["duration_s"] / 3600.0
    kept = hours > 0.01
    power = ((loaded.windows["energy_vi_kwh"] - plain.windows["energy_vi_kwh"]) / hours)[kept]
    rides = plain.rides.set_index("ride_key").loc[plain.windows["ride_key"][kept]]
    unit = {
        "ride": plain.windows["ride_key"][kept].to_numpy(),
        "day": (rides["vehicle_id"] + rides["date"]).to_numpy(),
        "driver": rides["driver_id"].to_numpy(),
        "date": rides["date"].to_numpy(),
        "car": rides["vehicle_id"].to_numpy(),
    }[level]
    known = pd.notna(unit)
    groups = power[known].groupby(unit[known])
    assert float(groups.std().max()) < 0.05  # a window next to a gap may lack a sample
    assert float(groups.mean().std()) > 0.1


def test_energy_at_a_size_of_one_is_recorded(source):
    tables = make_tables(source, RandomLoad("day", "constant", 300.0), RandomLoad("ride", "beginning", 500.0))
    hours = tables.windows["duration_s"].to_numpy() / 3600.0
    np.testing.assert_allclose(tables.hidden["day constant"], hours / 1000.0, atol=2e-5)
    assert 0.0 < tables.hidden["ride beginning"].sum() < tables.hidden["day constant"].sum()
