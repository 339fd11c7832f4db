"""Test that the nomenclature describes every column of both tables, in units that pint knows."""

import pandas as pd
import pint
import pytest

from socast.core import columns
from socast.core.cleaning.quality import CAUSES
from socast.core.columns import RIDE_COLUMNS, SIGNALS, TELEMETRY, WINDOW_COLUMNS, expand_effect_columns
from socast.core.effects import list_tabulated
from socast.core.models.features import FEATURES
from socast.core.wire.messages import Telemetry

GROUPS = {"telemetry": TELEMETRY, "signals": SIGNALS, "rides": RIDE_COLUMNS, "windows": WINDOW_COLUMNS}


@pytest.mark.parametrize(("file", "declared"), [("rides", RIDE_COLUMNS), ("windows", WINDOW_COLUMNS)])
def test_tables_of_a_recording_have_exactly_the_declared_columns(shift_tables, file, declared):
    table = pd.read_parquet(shift_tables / f"{file}.parquet")
    effects = [name.removeprefix("effect_") for name in table if name.startswith("effect_")]
    assert set(effects) == set(list_tabulated())
    assert list(table) == [column.name for column in expand_effect_columns(declared, effects)]


@pytest.mark.parametrize("group", GROUPS)
def test_every_column_has_a_unique_name_a_meaning_a_source_and_a_unit_of_pint(group):
    registry = pint.UnitRegistry()
    names = [column.name for column in GROUPS[group]]
    assert len(set(names)) == len(names)
    for column in GROUPS[group]:
        assert column.meaning, column.name
        assert column.source, column.name
        assert column.low <= column.high
        registry.Unit(column.unit)


def test_telemetry_columns_come_from_fields_of_the_message():
    fields = Telemetry.__struct_fields__
    assert [column.source for column in TELEMETRY] == [fields[1], *fields[3:]]


def test_every_quality_bit_has_a_column_of_the_ride_table():
    names = [column.name for column in RIDE_COLUMNS if column.name.startswith("quality_")]
    assert names == [f"quality_{cause}" for cause in CAUSES]


def test_columns_that_models_read_have_the_unit_of_the_ride_table():
    registry = pint.UnitRegistry()
    units = {column.name: column.unit for column in RIDE_COLUMNS}
    for name, unit in FEATURES.items():
        declared = {"degC": "K"}.get(units[name], units[name])  # models read differences of temperature
        assert registry.Unit(unit) == registry.Unit(declared), name


def test_numeric_columns_of_a_table_are_those_with_a_unit(shift_tables):
    table = pd.read_parquet(shift_tables / "rides.parquet")
    for column in RIDE_COLUMNS:
        if column is not columns.EFFECT_COLUMN:
            numeric = pd.api.types.is_numeric_dtype(table[column.name]) and table[column.name].dtype != bool
            assert numeric == (column.unit != ""), column.name
