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


def test_flattened_counters_omit_zeros_and_empty_values():
    assert flatten_counts({"a": {"b": {"c": 1, "d": 0}}, "e": 2, "f": {}}) == {"a.b.c": 1, "e": 2}
