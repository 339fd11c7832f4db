"""Test the lines of the log and the counts in them."""

import json
import logging

import pytest

from socast.stream.structured_log import LineFormatter, flatten_counts


def test_nan_is_null_in_json_log_line():
    record = logging.LogRecord("socast", logging.INFO, "", 0, "ride", None, None)
    record.fields = {"ambient_c": float("nan"), "distance_km": 1.5}
    logged = json.loads(LineFormatter(as_json=True).format(record), parse_constant=pytest.fail)
    assert (logged["ambient_c"], logged["distance_km"]) == (None, 1.5)


@pytest.mark.parametrize("as_json", [False, True])
def test_numbers_have_four_significant_digits(as_json):
    record = logging.LogRecord("socast", logging.INFO, "", 0, "ride", None, None)
    record.fields = {"energy_kwh": 1.23456789, "gain_kwh": 0.000123456, "rate": 12345.678, "rides": 1234567}
    line = LineFormatter(as_json=as_json).format(record)
    for number in ("1.235", "0.0001235", "12346", "1234567"):
        assert number in line
    assert "1.2345" not in line


def test_flattened_counters_omit_zeros_and_empty_values():
    assert flatten_counts({"a": {"b": {"c": 1, "d": 0}}, "e": 2, "f": {}}) == {"a.b.c": 1, "e": 2}
