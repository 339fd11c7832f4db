"""Test the format of numbers for people."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from socast.core.formatting import everyday, format_minus, format_range, rounded


@pytest.mark.parametrize(
    ("value", "unit", "text"),
    [(268.15, "K", "-5 °C"), (90.0, "s", "90 s"), (3600.0, "s", "60 min"), (0.002, "m", "2 mm"), (2.5, "m", "2.5 m"),
     (25.0, "m/s", "90 km/h"), (0.85, "1", "0.85"), (360.0, "V", "360 V")],
)  # fmt: skip
def test_quantity_is_shown_in_its_everyday_unit(value, unit, text):
    assert everyday(value, unit) == text


@pytest.mark.parametrize(
    ("value", "half", "text"),
    [(1.1349, 0.2, "1.1 ± 0.2"), (-1.1349, 0.2, "-1.1 ± 0.2"), (0.0, 0.15, "0.00 ± 0.15"), (1234.0, 56.0, "1230 ± 60"),
     (99.6, 0.0, "100"), (5.0, None, "5.0"), (0.0, None, "0"), (float("nan"), 1.0, "nan ± 1.0"),
     (1.0, float("inf"), "1.0"), (1.0, float("nan"), "1.0")],
)  # fmt: skip
def test_number_is_rounded_to_its_uncertainty(value, half, text):
    assert rounded(value, half) == text


@given(st.floats(1e-6, 1e6), st.floats(1e-3, 10))
def test_rounded_number_differs_by_at_most_a_third_of_the_uncertainty(value, share):
    half = value * share
    shown = rounded(value, half).split(" ± ")
    assert abs(float(shown[0]) - value) <= half / 3
    assert float(shown[1]) == pytest.approx(half, rel=0.3)


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("-0.000", "0.000"),
        ("+0.000 ± 0.012", "0.000 ± 0.012"),
        ("(-0.0 %)", "(0.0 %)"),
        ("-0", "0"),
        ("-0.001", "−0.001"),
        ("+0.010", "+0.010"),
        ("-0e+3", "−0e+3"),
        ("2018-01-02", "2018-01-02"),
    ],
)
def test_number_that_is_rounded_to_zero_has_no_sign(text, shown):
    assert format_minus(text) == shown


def test_ranges_have_one_style():
    shown = [format_range(name) for name in ("0-5", "5 to 10", "-5 to 0", "below -5", "30+", "taxi-003", "2018-01-02")]
    assert shown == ["0 to 5", "5 to 10", "−5 to 0", "below −5", "30+", "taxi-003", "2018-01-02"]
