"""The measurement of error locations judges names and sizes, and states shares with their intervals."""

import pytest

from socast.core.diagnose.error_location.locate import ErrorLocation, LocatedLoad
from socast.tools.bench.error_location import CASES, format_share, judge, make_lines, summarise


def make_location(*loads):
    return ErrorLocation(loads, loads, {}, ("ride", "day"), (), ())


def make_load(level, kind, size):
    return LocatedLoad(level, kind, size, 0.9 * size, 1.1 * size, "W", size, 0.9 * size, 1.1 * size, 40.0, True)


def test_location_with_all_loads_and_no_other_is_right():
    found = judge(make_location(make_load("ride", "constant", 310.0)), {"ride constant": 300.0})
    assert (found["right"], found["found"], found["inside"]) == (True, 1, 1)
    assert found["ratios"] == [pytest.approx(310.0 / 300.0)]


def test_additional_load_is_wrong_and_size_beyond_its_interval_is_outside():
    loads = make_load("ride", "constant", 400.0), make_load("day", "drag", 90.0)
    found = judge(make_location(*loads), {"ride constant": 300.0})
    assert (found["right"], found["found"], found["inside"]) == (False, 1, 0)
    assert not judge(make_location(), {"ride constant": 300.0})["right"]


def test_nothing_claimed_is_right_where_nothing_is_hidden():
    assert judge(make_location(), {})["right"]


def test_lines_have_a_row_for_each_case():
    records = [judge(make_location(), {}) | {"case": name, "rides": 1300, "seconds": 2.0, "seed": 1} for name in CASES]
    section = "\n".join(make_lines(summarise(records), records))
    assert all(f"| {name} |" in section for name in CASES)
    assert "1 of 1 (21 to 100 %)" in section
    assert format_share(0, 0) == "–"
