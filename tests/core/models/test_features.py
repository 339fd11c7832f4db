"""Test that every column a model may read is known during a ride, has a unit, and does not hold the answer."""

import numpy as np
import pandas as pd
import pint
import pytest

from socast.core.columns import ZERO_CELSIUS
from socast.core.errors import EffectError, ModelError
from socast.core.fit.recipes import RECIPES
from socast.core.models.features import (
    DERIVED_COLUMNS,
    FEATURES,
    Columns,
    derive_coefficient_unit,
    get_unit,
    list_raw_columns,
    parse_since,
)
from socast.core.pipeline import Pipeline
from socast.core.totals.tables import model_columns
from tests.support.planted_rides import PLANTED, rides

TERMS = sorted({term.columns for recipe in RECIPES.values() for term in getattr(recipe, "terms", ())})


@pytest.fixture(scope="module")
def units() -> pint.UnitRegistry:
    return pint.UnitRegistry()


@pytest.mark.parametrize("columns", TERMS, ids="*".join)
def test_coefficient_times_columns_is_an_energy(columns, units):
    total = units.Quantity(1.0, derive_coefficient_unit(columns))
    for column in columns:
        total = total * units.Quantity(1.0, "dimensionless" if get_unit(column) == "1" else get_unit(column))
    assert total.check("[energy]")
    assert total.to("kWh").magnitude == pytest.approx(1.0)


@pytest.mark.parametrize("column", ["soc_end_pct", "energy_kwh", "energy_soc_kwh", "energy_vi_sd_kwh", "hvac_kwh"])
def test_column_that_holds_the_answer_is_no_feature(column):
    assert column not in FEATURES
    with pytest.raises(ModelError, match="holds what is to be predicted"):
        get_unit(column)


@pytest.mark.parametrize("column", ["distance", "vehicle_id", "", "quality_gap", "unfit_reason"])
def test_unknown_column_is_refused_by_name(column):
    with pytest.raises(ModelError, match=f"column {column!r} is not one that a model can read"):
        get_unit(column)
    with pytest.raises(EffectError, match="effect 'nothing' is unknown"):
        get_unit("effect_nothing")


def test_every_feature_is_numeric_and_available_during_a_ride():
    pipeline = Pipeline()
    table = pipeline.take_rides()
    running = model_columns(
        pipeline.totals.accumulator.running(np.empty(0, np.int64)), pipeline.context, ["winter", "vehicle_id"]
    )
    for column in FEATURES:
        assert pd.api.types.is_numeric_dtype(table[column]), column
        assert column in running, column
    for column in (name for derived in DERIVED_COLUMNS for name in list_raw_columns(derived)):
        assert column in FEATURES or column.startswith("effect_"), column


def test_wind_components_follow_the_direction_the_wind_comes_from():
    table = pd.DataFrame({"wind_from_deg": [0.0, 90.0, 180.0, 270.0, 359.999999, np.nan]})
    north, east = Columns(table)["wind_from_north"], Columns(table)["wind_from_east"]
    np.testing.assert_allclose(north, [1.0, 0.0, -1.0, 0.0, 1.0, np.nan], atol=1e-7)
    np.testing.assert_allclose(east, [0.0, 1.0, 0.0, -1.0, 0.0, np.nan], atol=1e-7)


def test_accessory_energy_is_curve_power_times_duration_and_scale():
    table = rides(50)
    power = PLANTED.power(table["ambient_c"].to_numpy() + ZERO_CELSIUS) * table["accessory_scale"]
    expected = table["duration_s"] / 3600.0 * power / 1000.0
    np.testing.assert_allclose(Columns(table, {}, PLANTED)["accessories_kwh"], expected, rtol=1e-12)
    with pytest.raises(ModelError, match="needs an accessory curve"):
        _ = Columns(table)["accessories_kwh"]


def test_fills_replace_only_unknown_values():
    table = pd.DataFrame({"ambient_c": [np.nan, 5.0], "wind_from_deg": [np.nan, 90.0], "lost_m": [np.nan, 2.0]})
    seen = Columns(table, {"ambient_c": -3.0, "wind_from_east": 0.25})
    assert seen["ambient_c"].tolist() == [-3.0, 5.0]
    assert seen["wind_from_east"].tolist() == [0.25, 1.0]
    assert np.isnan(seen["lost_m"]).tolist() == [True, False]
    assert np.isnan(table["ambient_c"]).tolist() == [True, False]


MIDNIGHT = 1_527_811_200.0
"""1 June 2018, UTC."""


def test_scope_is_one_where_a_term_holds_and_zero_elsewhere():
    table = pd.DataFrame(
        {"vehicle_id": ["a", "b", None, "a"], "start_s": [MIDNIGHT - 1e-3, MIDNIGHT, MIDNIGHT + 1.0, np.nan]}
    )
    assert Columns(table)["vehicle=a"].tolist() == [1.0, 0.0, 0.0, 1.0]
    assert Columns(table)["since=2018-06-01"].tolist() == [0.0, 1.0, 1.0, 0.0]
    assert Columns(table, rows=np.array([1, 3]))["vehicle=a"].tolist() == [0.0, 1.0]
    assert parse_since("since=2018-06-01") == MIDNIGHT
    assert (list_raw_columns("vehicle=a"), list_raw_columns("since=2018-06-01")) == (("vehicle_id",), ("start_s",))
    assert derive_coefficient_unit(("effect_cold_rolling", "vehicle=a", "since=2018-06-01")) == "1/K"


@pytest.mark.parametrize(
    ("scope", "message"),
    [
        ("since=2018-13-01", "month must be in 1..12"),
        ("since=", "write since=YYYY-MM-DD"),
        ("since=yesterday", "write since=YYYY-MM-DD"),
        ("since=20180601", "write the date as since=2018-06-01"),
        ("vehicle=", "names no vehicle: write vehicle=ID"),
        ("vehicle= ", "names no vehicle: write vehicle=ID"),
    ],
)
def test_malformed_scope_is_refused(scope, message):
    with pytest.raises(ModelError, match=message):
        get_unit(scope)


def test_scope_accepts_any_vehicle_name():
    table = pd.DataFrame({"vehicle_id": ["vehicle=a=b", "since=2018-06-01", "é 1"]})
    for i, name in enumerate(table["vehicle_id"]):
        assert get_unit(f"vehicle={name}") == "1"
        assert Columns(table)[f"vehicle={name}"].argmax() == i
        assert Columns(table)[f"vehicle={name}"].sum() == 1.0
