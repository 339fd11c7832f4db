"""Test the table of forecasts."""

import json

from socast.core.forecast.forecast_table import FORECAST_COLUMNS, tabulate_forecasts
from socast.core.wire.messages import Message


def test_table_has_the_same_columns_whatever_is_known():
    forecast = {"vehicle_id": "a", "time_s": 1.0, "range_km": None, "soc_pct": 80.0, "of_a_later_version": 1}
    message = Message("fleet/a/forecast", json.dumps(forecast).encode(), 0)
    assert [*tabulate_forecasts([message])] == [*FORECAST_COLUMNS, "of_a_later_version"]
    assert [*tabulate_forecasts([])] == [*FORECAST_COLUMNS]


def test_other_messages_are_passed_over():
    assert tabulate_forecasts([Message("fleet/a/telemetry", b"not json", 0)]).empty


def test_nested_fields_are_columns():
    assert {"range_km.mean", "quality.gap", "next_charge.time_s", "next_charge.soc_pct.p05"} < {*FORECAST_COLUMNS}
    assert not {"range_km", "quality", "next_charge"} & {*FORECAST_COLUMNS}
