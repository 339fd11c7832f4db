"""Test the report of an evaluation: its content, notes on the paper's data, and odd or missing parts."""

import re
from collections import defaultdict
from functools import partial
from io import StringIO

import plotly.graph_objects as go
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from socast.core.errors import SettingsError
from socast.core.evaluate.binning import SEASONS
from socast.core.evaluate.paper import published
from socast.core.evaluate.paper.records import RecipeEvaluation
from socast.tools.report.document import print_section
from socast.tools.report.evaluation import selection
from socast.tools.report.evaluation.page import (
    MAKERS,
    PAPER_CAPTION,
    build_illustrations,
    build_report,
    build_sections,
    show,
)
from socast.tools.report.figure_style import get_style
from socast.tools.report.page import render_report, write_report
from socast.tools.report.table import PAPER_NOTE, UNKNOWN
from socast.tools.terminal.output import REPORT_VERSIONS
from tests.support.evaluation_result import CLUSTERS, RECIPES, VEHICLES, evaluation, hold
from tests.support.html_pages import read_page
from tests.support.read_parts import find_read_fields

pytestmark = pytest.mark.long
FEW_RECIPES = ("basic_physical", "fitted_physical", "hybrid_trees")
FEW_VEHICLES = ("kia-soul-ev-2015", "nissan-leaf-2016")
ODD = '<b>R&D\'s "best"</b> [red]model[/red] </script><script>alert(1)</script>'


def printed(result, width=120):
    """Return the terminal output."""
    console = Console(width=width, file=StringIO(), color_system=None)
    show(result, console)
    return console.file.getvalue()


def printed_changes(result, before):
    """Return the terminal output of a result without the sections that another result has too."""
    known = build_sections(before)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            "socast.tools.report.document.print_section",
            lambda section, console: None if section in known else print_section(section, console),
        )
        return printed(result)


def smaller(value):
    """Return a result with fewer models and vehicle models, which is faster to draw."""
    gone = (set(RECIPES) - set(FEW_RECIPES)) | (set(VEHICLES) - set(FEW_VEHICLES))
    if isinstance(value, list):
        return [smaller(item) for item in value if isinstance(item, dict) or item not in gone]
    if not isinstance(value, dict):
        return value
    return {key: smaller(item) for key, item in value.items() if not gone & set(str(key).split("|"))}


def drawn(result, sections=MAKERS):
    """Return the figures of sections of a report, of all without `sections`, by key."""
    return {one.key: one for section in sections for one in build_illustrations(result, section)}


@pytest.fixture(scope="module")
def result():
    return hold(evaluation())


@pytest.fixture(scope="module")
def small():
    return hold(smaller(evaluation()))


@pytest.fixture(scope="module")
def readers(small):
    """Return the sections whose figures read each part of a result; no other figure can depend on the part."""
    found = defaultdict(list)
    for section in MAKERS:
        for part in find_read_fields(partial(build_illustrations, section=section), small):
            found[part].append(section)
    return found


@pytest.fixture(scope="module")
def html(result):
    return render_report(build_report(result))


@pytest.fixture(scope="module")
def every_figure(result):
    return drawn(result)


@pytest.fixture(scope="module")
def terminal(result):
    return printed(result)


def test_page_is_well_formed_and_its_links_have_targets(html):
    reader = read_page(html)
    assert len(reader.ids) == len(set(reader.ids))
    assert set(reader.links) <= set(reader.ids)
    assert {section.key for section in build_sections(hold(evaluation()))} <= set(reader.links)


def test_page_carries_its_report_name_and_format_version(html):
    reader = read_page(html)
    (content,) = (attrs["content"] for _, attrs in reader.tags if attrs.get("name") == "socast-format")
    assert content == f"evaluate {REPORT_VERSIONS['evaluate']}"


def test_page_loads_no_external_resource(html):
    reader = read_page(html)
    assert reader.loaded == []
    assert html.count("* plotly.js v") == 1
    policy = next(attrs["content"] for tag, attrs in reader.tags if attrs.get("http-equiv"))
    assert policy.startswith("default-src 'none'")
    assert "http" not in policy
    assert not re.search(r"@import|url\(", html.partition("</style>")[0])


def test_every_figure_has_text_for_screen_readers(html, every_figure):
    reader = read_page(html)
    plots = [attrs for tag, attrs in reader.tags if attrs.get("class") == "plot"]
    assert len(plots) == len(every_figure) > 20
    assert all(attrs["role"] == "img" and len(attrs["aria-label"]) > 40 for attrs in plots)
    for one in every_figure.values():
        assert one.caption in "".join(reader.text)


def test_every_axis_has_title_and_numeric_axes_have_unit(every_figure):
    for key, one in every_figure.items():
        axes = [*one.figure.select_xaxes(), *one.figure.select_yaxes()]
        assert len(axes) >= 2, key
        for axis in axes:
            assert axis.title.text, key
            named = axis.type == "category" or axis.tickvals is not None
            assert named or re.search(r"\[[^\]]+\]$", axis.title.text), f"{key}: {axis.title.text}"


def test_figures_are_readable_without_colour(every_figure):
    looks = [get_style(place) for place in range(30)]
    assert len({(look.dash, look.symbol) for look in looks}) == len(looks)
    for one in every_figure.values():
        lines = [
            t for t in one.figure.data if t.type == "scatter" and t.mode == "lines+markers" and t.xaxis in {None, "x"}
        ]
        assert len({(t.line.dash, t.marker.symbol) for t in lines}) == len(lines)
        patterns = [t.marker.pattern.shape for t in one.figure.data if t.type == "bar"]
        assert len(set(patterns)) == len(patterns)


def test_tables_and_figures_with_values_of_paper_state_other_data(result, html, every_figure, terminal):
    beside = [table for section in build_sections(result) for table in section.tables if table.beside_paper]
    assert {f"Table {n}" for n in range(2, 14)} <= set(re.findall(r"Table \d+", " ".join(t.title for t in beside)))
    assert all(PAPER_NOTE in table.all_notes for table in beside)
    assert html.count(PAPER_NOTE.replace("'", "&#x27;")) == len(beside)
    assert terminal.count(PAPER_NOTE) == len(beside)
    for one in every_figure.values():
        theirs = "the paper's" in one.figure.to_json()
        assert theirs == (PAPER_CAPTION in one.caption), one.key
    assert sum(PAPER_CAPTION in one.caption for one in every_figure.values()) == 3 + len(VEHICLES)


def test_values_of_paper_are_shown_beside_evaluation(terminal, html):
    for figure in ("(0.33 ± 0.0052)", "(118,621)", "(51.75 %)", "(30.75 %)", "(about 12 %)", "1 kWh"):
        assert figure in terminal
        assert figure in "".join(read_page(html).text)


def test_figure_3_shows_averages_of_paper_as_outlines(every_figure):
    traces = every_figure["average"].figure.data
    outlines = [t for t in traces if str(t.marker.symbol).endswith("-open")]
    assert len(outlines) == len(VEHICLES)
    shown = [x for x in outlines[0].x if x is not None]
    assert shown == [published.get_mae(r, "kia-soul-ev-2015", "average").value for r in list(RECIPES)[:7]]


def test_error_tables_have_layout_of_paper(result):
    tables = next(section.tables for section in build_sections(result) if section.key == "errors")
    assert len(tables) == len(RECIPES)
    assert all(table.columns == (*(f"{c.replace('-', ' to ')} km" for c in CLUSTERS), "average *") for table in tables)
    assert all(table.rows[-1].name == "Weighted average" for table in tables)
    basic = tables[0].rows[0].cells[0]
    figure = result.mae["basic_physical"]["kia-soul-ev-2015"]["0-5"]
    assert basic.text == f"{figure.value:.3f} ± {figure.ci95:.4f}"


def test_terminal_output_fits_120_columns_and_has_every_table(result, terminal):
    assert max(len(line) for line in terminal.splitlines()) <= 120
    for section in build_sections(result):
        for table in section.tables:
            assert section.folded or table.title[:60] in terminal


def test_terminal_output_ends_with_principal_figures(terminal):
    assert "At a glance" in "".join(terminal.splitlines()[-45:])


def odd(where):
    """Return an odd name for a place in a result."""
    return f"{ODD} of {where}"


@pytest.fixture(scope="module")
def odd_report():
    """Return the page of a result with odd names, what a reader finds in it, and the terminal output."""
    result = renamed(smaller(evaluation()), FEW_VEHICLES[0], odd("vehicle"))
    result["recipes"]["hybrid_trees"] = odd("recipe")
    result["about"]["unfit"][odd("reason")] = 7
    result["about"]["notes"] = [odd("note")]
    for entries in result["by"]["driver"].values():
        del entries[5:]
        entries[0]["bin"] = odd("driver")
    html = render_report(build_report(hold(result)))
    return html, read_page(html), printed(hold(result), width=1000)


@pytest.mark.parametrize("where", ["recipe", "vehicle", "reason", "driver", "note"])
def test_odd_names_are_shown_unchanged(where, odd_report):
    html, reader, text = odd_report
    tags = [tag for tag, _ in reader.tags]
    assert tags.count("script") == 2 + tags.count("figure")
    assert odd(where) in "".join(reader.text)
    assert odd(where) in text
    assert "\\u003cb>" not in html, "a figure would read the tag"


def renamed(value, old, new):
    """Return a result with one key or value replaced by another."""
    if isinstance(value, dict):
        return {(new if key == old else key): renamed(item, old, new) for key, item in value.items()}
    if isinstance(value, list):
        return [renamed(item, old, new) for item in value]
    return new if value == old else value


@pytest.mark.parametrize("part", list(evaluation()))
def test_result_with_missing_part_is_reported(part, small, readers):
    result = hold({key: value for key, value in smaller(evaluation()).items() if key != part})
    assert drawn(result, readers[part]) is not None
    assert "The paper" in printed_changes(result, small)


@pytest.mark.parametrize("part", ["mae", "coverage", "by", "new_vehicle", "few_shot", "difference", "selection"])
def test_part_with_null_figures_has_no_drawing(part, small, readers):
    whole = smaller(evaluation())
    result = hold(whole | {part: nulled(whole[part])})
    assert readers[part]
    assert not {key for key in drawn(result, readers[part]) if key.startswith((part.replace("_", "-"), f"{part}-"))}
    assert "None" not in printed_changes(result, small)


def nulled(value):
    """Return a part of a result with its numbers replaced by None, but for counts."""
    if isinstance(value, dict):
        return {key: nulled(item) for key, item in value.items()}
    if isinstance(value, list):
        return [nulled(item) for item in value]
    return value if isinstance(value, str | int) else None


def test_empty_result_gives_page_and_terminal_output():
    page = read_page(render_report(build_report(RecipeEvaluation())))
    assert "Evaluation of consumption models" in "".join(page.text)
    assert "The paper" in printed(RecipeEvaluation())


def test_non_finite_values_are_not_shown():
    result = smaller(evaluation())
    result["mae"]["hybrid_trees"]["kia-soul-ev-2015"]["0-5"] = {"value": float("nan"), "ci95": float("inf")}
    assert "nan" not in printed(hold(result)).replace("dominan", "")
    assert "NaN" not in render_report(build_report(hold(result))).rpartition("<section")[0].partition("<main")[2]


def test_reporting_does_not_change_result(small):
    render_report(build_report(small))
    printed(small)
    assert small == hold(smaller(evaluation()))


def test_best_of_column_is_emphasised_and_dominance_is_marked(result):
    table = next(t for s in build_sections(result) for t in s.tables if t.title.endswith("(Figure 3)"))
    assert {row.name for row in table.rows if row.cells[0].strong} == {RECIPES["hybrid_trees"]}
    for mark, score in (("●", "dominates"), ("○", "dominates_average")):
        marked = {row.name for row in table.rows if mark in row.cells[0].text}
        assert marked == {RECIPES[recipe] for recipe in getattr(result, score)["kia-soul-ev-2015"]}


def test_coverage_outside_its_limits_is_marked():
    result = smaller(evaluation())
    result["coverage"]["hybrid_trees"]["cluster"]["0-5"] = 0.849
    result["coverage"]["hybrid_trees"]["season"][SEASONS[0]] = 0.851
    result["coverage"]["hybrid_trees"]["overall"] = 0.93
    table = next(t for s in build_sections(hold(result)) for t in s.tables if t.title.startswith("Rides inside"))
    cells = dict(zip(table.columns, (cell.text for cell in table.rows[-1].cells), strict=True))
    assert cells["0 to 5 km"] == "84.9 % ↓"
    assert cells[SEASONS[0]] == "85.1 %"
    assert cells["overall"] == "93.0 % ↑"


def test_loss_of_elimination_is_shown(result):
    table = next(t for s in build_sections(result) for t in s.tables if t.title.startswith("Terms that can be removed"))
    rows = {row.name.partition(":")[0]: row.cells[-1].text for row in table.rows}
    assert rows["RFE"] == "+0.0006 ± 0.0005"


def test_narrow_tables_have_columns_of_principal_models():
    result = evaluation()
    result["coverage"] = dict.fromkeys(RECIPES, result["coverage"]["hybrid_trees"])
    chosen = ["basic_physical", "fitted_physical", "hybrid_interactions", "segment_network", "hybrid_trees"]
    titles = [RECIPES[recipe] for recipe in chosen]
    tables = {t.title: t for s in build_sections(hold(result)) for t in s.tables}
    assert tables["Mean absolute error by distance, kWh"].columns[1:] == tuple(titles)
    inside = [row.name.partition(": ")[2] for row in tables["At a glance"].rows if row.name.startswith("Rides inside")]
    assert inside == titles
    heads = printed(hold(result)).partition("Mean absolute error by distance, kWh")[2].splitlines()[2:6]
    words = {word.strip() for line in heads for word in line.split()}
    assert words >= {word for title in titles for word in title.split()}


def test_errors_above_fitted_physical_model_on_new_vehicle_are_marked():
    result = smaller(evaluation())
    result["few_shot"]["kia-soul-ev-2015"]["hybrid_trees"][0]["mae"] = 99.0
    tables = [t for s in build_sections(hold(result)) if s.key == "transfer" for t in s.tables]
    table = next(t for t in tables if t.title.startswith("Kia"))
    marked = [cell.text.endswith("↑") for row in table.rows for cell in row.cells]
    assert marked.index(True) == table.columns.index(RECIPES["hybrid_trees"])
    assert sum(marked) == 1


def test_split_tables_state_whether_best_models_differ():
    result = smaller(evaluation())
    for key in FEW_VEHICLES:
        result["splits"]["date"]["hybrid_trees"][key] = 9.0
    table = next(t for s in build_sections(hold(result)) if s.key == "splits" for t in s.tables)
    assert any(note.startswith("They differ on the best model") for note in table.notes)
    for key in FEW_VEHICLES:
        result["splits"]["date"]["hybrid_trees"][key] = 0.01
    table = next(t for s in build_sections(hold(result)) if s.key == "splits" for t in s.tables)
    assert any(note.startswith("The same model is best") for note in table.notes)


@given(value=st.floats(-50, 50), p=st.floats(0, 1))
def test_difference_matrix_is_antisymmetric(value, p):
    pairs = {"basic_physical|fitted_physical": {"value": value, "ci95": 0.1, "p": p}}
    made = selection.draw_difference_matrix(hold({"recipes": RECIPES, "difference": {"x": pairs}}), "x")
    (heat,) = made.data
    assert heat.customdata[0][1] == 1000.0 * value == -heat.customdata[1][0]
    assert heat.z[0][1] == -heat.z[1][0]
    assert heat.z[0][0] is None
    assert ("*" in heat.text[0][1]) == (p < 0.05) == ("*" in heat.text[1][0])


def test_few_shot_axis_shows_zero_rides_before_one(every_figure):
    made = every_figure["few-shot-0"].figure
    assert made.layout.xaxis.type == "log"
    assert list(made.layout.xaxis.ticktext) == ["0", "1", "3", "10", "30", "100"]
    assert all(x > 0 for trace in made.data for x in trace.x)


def test_accessory_curve_passes_through_its_choke_points(every_figure):
    traces = {trace.name: trace for trace in every_figure["curve-0"].figure.data}
    assert list(traces["choke points"].x) == pytest.approx([-20.0, 12.0, 21.0, 35.0])
    assert list(traces["choke points"].y) == pytest.approx([4.0, 0.3, 0.3, 1.5])
    assert set(traces["choke points"].x) <= set(traces["fitted curve"].x)


def test_each_model_has_same_symbol_in_every_figure(every_figure):
    seen = {}
    for key in ("relative", "by-distance", "by-temperature", "coverage"):
        for trace in every_figure[key].figure.data:
            assert seen.setdefault(trace.name, trace.marker.symbol) == trace.marker.symbol


def test_figures_are_plotly_figures(every_figure):
    assert all(isinstance(one.figure, go.Figure) for one in every_figure.values())
    assert UNKNOWN not in {trace.name for one in every_figure.values() for trace in one.figure.data}


def test_page_is_written(small, tmp_path):
    path = tmp_path / "report.html"
    write_report(build_report(small), path)
    assert path.read_text(encoding="utf-8").startswith("<!DOCTYPE html>")


def test_unwritable_page_raises_error_of_one_line(tmp_path):
    with pytest.raises(SettingsError, match=r"report\.html cannot be written: No such file"):
        write_report(build_report(RecipeEvaluation()), tmp_path / "nowhere" / "report.html")
