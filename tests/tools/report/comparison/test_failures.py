"""Test the picture of where a model fails: in a terminal, and as figures."""

import msgspec
import pytest

from socast.core.evaluate.compare.records import ResidualChart, ResidualSurvey
from socast.tools.report.comparison.failures import describe_worst_bin, draw_chart, illustrate_change, name_bin
from tests.support.html_pages import assert_axes_are_titled


def make_chart(mean, q, *, number=True, names=(), key="headwind_kmh"):
    """Return a chart whose bins are 1 km/h or a name wide, with intervals of +-50 W."""
    count = len(mean)
    bins = {
        "x": list(names) or [place + 0.5 for place in range(count)],
        "low": [float(place) for place in range(count)] if number else [],
        "high": [place + 1.0 for place in range(count)] if number else [],
        "mean": mean, "ci95": [50.0] * count, "q": q, "rows": [400] * count, "days": [40] * count,
    }  # fmt: skip
    column = {"key": key, "label": "Headwind" if number else "Car", "unit": "km/h" if number else "", "number": number}
    outside = sum(each < 0.05 for each in q)
    chart = {"column": column, "bins": bins, "outside": outside, "of": count, "spread": 1.0, "q": 0.001}
    return msgspec.convert(chart, ResidualChart)


@pytest.mark.parametrize("columns", [60, 80, 140])
@pytest.mark.parametrize("number", [True, False])
def test_picture_fits_the_terminal(columns, number):
    chart = make_chart([-12345.0, 0.0, 200.0], [0.01, 1.0, 0.01], number=number, names=() if number else ["a" * 60] * 3)
    *lines, legend = (line.plain for line in draw_chart(chart, columns))
    assert max(map(len, lines[1:])) <= columns
    assert len(lines[0]) <= 80
    assert "95 % interval" in legend


def test_line_of_zero_is_visible_in_every_bin_and_on_the_scale():
    lines = [line.plain for line in draw_chart(make_chart([-200.0, -20.0, 200.0], [0.01, 0.6, 0.01]), 80)]
    place = lines[1].index("│")
    assert [line[place] for line in lines[1:4]] == ["│", "┼", "│"]
    assert lines[4][place] == "0"
    assert lines[4].endswith("250 W")


def test_only_bins_off_zero_among_all_bins_are_marked():
    lines = [line.plain for line in draw_chart(make_chart([-200.0, 60.0], [0.01, 0.2]), 80)]
    assert [line.endswith(" *") for line in lines[1:3]] == [True, False]


def test_worst_bin_is_named_with_sign_interval_and_unit():
    chart = make_chart([-200.0, 300.0], [0.01, 0.2])
    assert describe_worst_bin(chart) == "200 ± 50 W less predicted than measured at 0.0 to 1.0 km/h"


def test_bins_of_one_value_have_no_range():
    chart = make_chart([-200.0, 300.0], [0.01, 0.2])
    chart.bins.high[0] = 0.0
    assert [name_bin(chart, place) for place in range(2)] == ["0.0 km/h", "1.0 to 2.0 km/h"]


def test_column_that_varies_by_chance_is_not_named():
    chart = make_chart([-200.0, 60.0], [0.01, 0.2])
    others = [msgspec.structs.replace(chart, **change) for change in ({"q": 0.2}, {"outside": 0})]
    assert ResidualSurvey(charts=[chart, *others]).failing == [chart]


def test_figure_of_a_step_holds_both_models_and_fills_what_is_off_zero():
    before, after = make_chart([-200.0, 200.0], [0.01, 0.01]), make_chart([-20.0, 20.0], [0.6, 0.6])
    (drawn,) = illustrate_change(ResidualSurvey(charts=[before]), ResidualSurvey(charts=[after]))
    assert [trace.name for trace in drawn.figure.data] == ["before", "after"]
    assert [list(trace.marker.symbol) for trace in drawn.figure.data] == [["square"] * 2, ["circle-open"] * 2]
    assert_axes_are_titled(drawn.figure)


def test_names_with_markup_stay_text_in_figures():
    chart = make_chart([-200.0, 200.0], [0.01, 0.01], number=False, names=["<b>a</b>", "b"])
    (drawn,) = illustrate_change(*[ResidualSurvey(charts=[chart])] * 2)
    assert drawn.figure.data[0].x[0] == "&lt;b&gt;a&lt;/b&gt;"
