"""`socast evaluate-soc` prints tables that fit, writes a self-contained page, and reports an error in one line."""

import json
import re
from io import StringIO

import numpy as np
import pytest
from msgspec.structs import asdict, replace
from rich.console import Console

from socast.core.errors import SettingsError
from socast.core.evaluate.records import EstimatedValue
from socast.core.evaluate.soc.recorders import LegRecorder
from socast.core.evaluate.soc.records import ClusteredShare, ForecastBin
from socast.core.evaluate.soc.report import evaluate_soc
from socast.core.evaluate.soc.reserve_risk import hold_share
from socast.core.models import EXTENDED_PHYSICAL
from socast.core.stats.clustered import LEAST_CLUSTERS
from socast.stream.mcap_reader import McapSource
from socast.tools.cli import main
from socast.tools.commands import evaluate_soc as command
from socast.tools.commands.import_drives import collect_drives, write_recording
from socast.tools.importers.data_sets import DATA_SETS
from socast.tools.importers.synthetic_shifts import concatenate_drives
from socast.tools.report.page import write_report
from socast.tools.report.soc import page as report
from socast.tools.report.soc.tables import (
    compare_with_best,
    describe_result,
    format_share,
    tabulate_alarms,
    tabulate_by_time,
    tabulate_conditions,
)
from tests.support.html_pages import read_page
from tests.support.paths import ROOT
from tests.support.soc_frames import make_frames

pytestmark = pytest.mark.long

DATA = ROOT.parent / "shared" / "data"
SHIFT = ROOT / "recordings" / "shift.mcap"
ODD = "<b>R&D's 'best'</b>"
SMALL = make_frames(cars=4, days=8)
FEW = make_frames(cars=1, days=2, hours=0.4, warm_up=0)


@pytest.fixture(scope="module")
def result():
    return evaluate_soc(*SMALL)


def printed(result):
    """Return what the terminal shows."""
    console = Console(width=120, file=StringIO(), color_system=None)
    report.show(result, console)
    return console.file.getvalue()


def figures(result):
    """Return all figures of the page, by key."""
    drawn = [one for section in report.build_sections(result) for one in report.build_report(result).draw(section.key)]
    return {one.key: one for one in drawn}


@pytest.fixture
def run(monkeypatch, capsys):
    """Return what runs the command on a recording whose pipeline reports planted shifts."""

    class Planted(command.Pipeline):
        def __init__(self, *arguments, keep_outlooks, **options):
            assert keep_outlooks
            super().__init__(*arguments, **options)
            self.planted = SMALL.outlooks

        def take_outlooks(self):
            forecasts, self.planted = self.planted, self.planted[:0]
            return forecasts

        def take_shifts(self):
            return SMALL.shifts

    monkeypatch.setattr(command, "Pipeline", Planted)

    def ran(*arguments):
        with pytest.raises(SystemExit) as ended:
            main(["evaluate-soc", *map(str, arguments)])
        return ended.value.code or 0, capsys.readouterr()

    return ran


def test_command_prints_and_writes_same_result(run, result, tmp_path):
    code, streams = run(SHIFT, "--json", tmp_path / "s.json", "--html", tmp_path / "s.html")
    assert code == 0, streams.err
    written = json.loads((tmp_path / "s.json").read_text())
    assert written.pop("format") == {"report": "evaluate-soc", "version": 1}
    assert written == result.to_json()
    assert printed(result) in streams.out
    assert f"report in {tmp_path / 's.html'}" in streams.out


def test_queries_of_legs_do_not_depend_on_lists_of_source():
    messages = [message for block in McapSource(SHIFT) for message in block]

    def recorded(size):
        told = command.SocForecasts(command.Pipeline(EXTENDED_PHYSICAL, keep_outlooks=True))
        lists = [messages[start : start + size] for start in range(0, len(messages), size)]
        asked, ask = [], told.pipeline.ask
        told.pipeline.ask = lambda vehicle: asked.append((vehicle, ask(vehicle))) or asked[-1][1]
        told._questions = LegRecorder(told.pipeline.ask)
        for part in told.cut(lists):
            told.pipeline.take(part)
            told()
        return asked

    whole = recorded(len(messages))
    assert len(whole) > 10
    assert recorded(997) == whole


def test_output_that_would_overwrite_recording_is_refused(run):
    code, streams = run(SHIFT, "--json", SHIFT)
    assert code == 2
    assert re.fullmatch(r"socast: [^\n]+would be overwritten[^\n]+\n", streams.err)


def test_recording_of_one_day_is_evaluated(capsys):
    with pytest.raises(SystemExit) as ended:
        main(["evaluate-soc", str(SHIFT)])
    assert not ended.value.code
    assert "Errors by condition" in capsys.readouterr().out


@pytest.mark.skipif(not DATA.is_dir(), reason=f"the public data sets are not at {DATA}")
def test_real_drives_in_synthetic_shifts_are_evaluated_against_their_end(tmp_path):
    drives = collect_drives([DATA / "ved_ev"], DATA_SETS["ved"])
    shifts = concatenate_drives(drives, 2.0)
    write_recording(drives, tmp_path / "ved.mcap", 3.0, shift_hours=2.0)
    with pytest.raises(SystemExit) as ended:
        main(["evaluate-soc", str(tmp_path / "ved.mcap"), "--json", str(tmp_path / "s.json")])
    assert not ended.value.code
    result = json.loads((tmp_path / "s.json").read_text())
    assert result["about"]["shifts"] == len(shifts)
    forecasts = result["forecasts"]
    assert len(forecasts["hours"]) + sum(result["about"]["left_out"].values()) >= len(shifts)
    became = {number: shift.drives[-1].rows["soc_pct"][-1] for number, shift in enumerate(shifts)}
    off = np.abs(np.array(forecasts["soc_end"]) - [became[number] for number in forecasts["shift"]])
    assert np.mean(off < 0.5) > 0.9  # one display falls by 9 % at once, just before its shift ends
    planned = [row for row, hours in enumerate(forecasts["hours"]) if hours > 0]
    assert planned
    assert all(forecasts["rating"][row] is not None for row in planned)
    assert all(forecasts["model_mean"][row] is not None for row in planned if forecasts["shift"][row] > 0)


def test_tables_show_figures_of_result(result):
    out = printed(result)
    for hours, group in result.overall.hours.items():
        (line,) = (line for line in out.splitlines() if line.startswith(f" {hours} h "))
        assert f"{group.mae_pct.value:.2f} ± {group.mae_pct.ci95:.2f}" in line
        assert format_share(group.coverage) in line
        assert f"{group.baselines['rating'].mae_pct.value:.2f}" in line
        assert hours == "0" or compare_with_best(group.best) in line
    assert "Evaluated from 2018-01-03 to 2018-01-08; 8 shifts ended before the first interval" in " ".join(out.split())
    assert out.index("By temperature") < out.index("Alarms") < out.index("Errors of the forecasts")
    assert [row.name for row in tabulate_by_time(result).rows] == ["0 h", "1 h", "2 h", "4 h", "6 h", "all"]


def test_page_is_self_contained_and_has_every_figure(result, tmp_path):
    write_report(report.build_report(result), tmp_path / "s.html")
    text = (tmp_path / "s.html").read_text()
    page = read_page(text)
    assert page.loaded == []
    assert set(page.links) <= set(page.ids)
    assert len(page.ids) == len(set(page.ids))
    names = ["error", "coverage", "width", "scatter", "by-0", "by-1", "risk", "example-0"]
    assert {f"figure-soc-{name}" for name in names} <= set(page.ids)


def test_axes_have_units_and_curves_differ_in_more_than_colour(result):
    for key, one in figures(result).items():
        layout = one.figure.layout
        assert re.search(r"\[[^\]]+\]$|^Vehicle model$", layout.xaxis.title.text), key
        assert re.search(r"\[[^\]]+\]$", layout.yaxis.title.text), key
        shown = [trace for trace in one.figure.data if trace.showlegend is not False]
        looks = [(trace.mode, trace.line.dash, trace.marker.symbol, trace.fill) for trace in shown]
        assert len(set(looks)) == len(looks), key


def test_scatter_shows_each_shift_once_at_its_values(result):
    inside, outside, _ = report.draw_scatter(result).data
    group = result.overall.hours["2"]
    assert len(inside.x) + len(outside.x) == group.n
    assert len(inside.x) / group.n == pytest.approx(group.coverage.value)


def test_risk_figure_shows_forecast_and_observed_risk():
    result = evaluate_soc(*make_frames(cars=6, days=9))
    *traces, equal = report.draw_risk(result).data
    levels, plan = (trace for trace in traces if trace.mode == "markers")
    few = {"levels" if trace.name.startswith("levels") else "plan" for trace in traces if trace.mode == "lines"}
    for points, key in ((levels, "levels"), (plan, "plan")):
        classes = result.reserve.reliability[key]
        assert list(points.x) == pytest.approx([100.0 * risk_class.told for risk_class in classes])
        shown = [100.0 * risk_class.fell.value if risk_class.fell.is_firm else None for risk_class in classes]
        assert list(points.y) == shown
        assert (None in shown) == (key in few)
    assert any(y is not None for y in levels.y)
    assert equal.x == equal.y


def coverages(*clusters):
    """Return shares of groups that rest on so many vehicle-days; of one alone there is no interval."""
    ends = {"low": 0.6, "high": 0.95}
    return {
        f"group {n}": ClusteredShare(value=0.8, clusters=n, **(ends if n > 1 else dict.fromkeys(ends)))
        for n in clusters
    }


def test_figure_of_few_vehicle_days_shows_only_interval():
    points, lines = report.draw_coverage(coverages(1, 2, LEAST_CLUSTERS - 1, LEAST_CLUSTERS), "Group [1]").data
    assert points.x == ("group 1", "group 2", "group 29", "group 30")
    assert points.y == (None, None, None, 80.0)
    assert lines.mode == "lines"
    assert lines.x == tuple(x for n in (1, 2, 29) for x in (f"group {n}", f"group {n}", None))
    assert lines.y == (None, None, None, 60.0, 95.0, None, 60.0, 95.0, None)
    (alone,) = report.draw_coverage(coverages(LEAST_CLUSTERS, 300), "Group [1]").data
    assert alone.y == (80.0, 80.0)


def test_groups_keep_their_order_even_if_too_small():
    made = report.draw_coverage(coverages(40, 2, 50), "Group [1]")
    assert made.layout.xaxis.categoryarray == ("group 40", "group 2", "group 50")


def test_interval_of_width_or_error_never_goes_below_zero(result):
    hours = {}
    for ahead, value, ci95 in (("1", 4.0, 5.0), ("2", 20.0, 1.0), ("4", 1.0, None)):
        width = EstimatedValue(value=value, ci95=ci95)
        none = {name: replace(each, mae_pct=EstimatedValue()) for name, each in result.overall.pooled.baselines.items()}
        hours[ahead] = replace(result.overall.pooled, width_pct=width, mae_pct=width, baselines=none)
    result = replace(result, overall=replace(result.overall, hours=hours))
    for trace in (report.draw_width(result).data[0], report.draw_errors(result).data[0]):
        assert trace.error_y.array == (5.0, 1.0, None)
        assert trace.error_y.arrayminus == (4.0, 1.0, None)
        assert trace.error_y.symmetric is False


def test_comparison_with_best_omits_few_vehicle_days(result):
    of_model = result.by["vehicle model"]
    assert all(group.hours["2"].best.vehicle_days == group.hours["2"].n == 12 for group in of_model)
    (table,) = (table for table in tabulate_conditions(result) if table.title == "By vehicle model")
    assert [row.cells[-1].text for row in table.rows] == ["–", "–"]
    many = evaluate_soc(*make_frames(cars=4, days=17))
    (table,) = (table for table in tabulate_conditions(many) if table.title == "By vehicle model")
    assert all(re.fullmatch(r"[+−][\d.]+ %", row.cells[-1].text) for row in table.rows)


def test_alarms_are_listed_by_level(result):
    table = tabulate_alarms(result)
    names = [row.name for row in table.rows]
    assert names[-2:] == ["20 to 60 %, 1 h", "20 to 60 %, 2 h"]
    group = result.reserve.overall["2"]
    assert [cell.text for cell in table.rows[-1].cells[:2]] == [str(group.n), str(group.fell)]
    assert table.rows[-1].cells[2].text.startswith(f"{group.alarms.caught}: ")
    missed = {row.name: int(row.cells[3].text) for row in table.rows}
    of_plan = result.reserve.levels.get("plan", {})
    for hours in {"1", "2"} & of_plan.keys():
        assert missed.get(f"the plan's reserve, {hours} h", 0) == of_plan[hours].alarms.missed


def test_truth_without_displays_is_refused(tmp_path):
    path = tmp_path / "x.truth.json"
    for text, expected in (("{}", "holds no displays; simulate with"), ("[", "is not the truth of a simulation")):
        path.write_text(text)
        with pytest.raises(SettingsError, match=expected):
            command.read_displays(path)
    path.write_text('{"displays": [{"vehicle_id": "a", "begin_s": 1.0, "step_s": 60.0, "shown_pct": [50.0]}]}')
    assert command.read_displays(path)["vehicle_id"].tolist() == ["a"]


def test_regression_stands_beside_the_forecasts():
    out = printed(evaluate_soc(*make_frames(cars=6, days=20)))
    assert "Intervals beside those of the regression" in out
    assert "Risk beside that of the regression" in out
    assert "By shifts seen" in out


def test_legs_are_shown_only_if_any_were_queried(result):
    assert "Leg by leg" not in printed(result)
    bins = [ForecastBin(bin=name, **asdict(result.overall.hours["1"])) for name in ("below 30", "all")]
    out = printed(replace(result, legs={"without a charge": bins, "charged later": []}))
    assert out.count("minutes ahead") == 1
    (line,) = (line for line in out.splitlines() if line.startswith(" below 30 "))
    assert format_share(bins[0].coverage) in line
    assert f"{bins[0].baselines['rating'].mae_pct.value:.2f}" in line


def test_share_of_few_vehicle_days_is_not_shown(result):
    out = printed(result)
    for part in result.by["temperature"]:
        few, shown = part.pooled.vehicle_days < 30, format_share(part.pooled.coverage)
        (line,) = (line for line in out.splitlines() if line.startswith(f" {part.bin.replace('-', '−')} "))
        assert shown in line
        assert shown.startswith("–") == few
    assert any(part.pooled.vehicle_days < 30 for part in result.by["temperature"])


@pytest.mark.parametrize(
    ("hits", "n", "vehicle_days", "is_shown"), [(740, 800, 20, True), (740, 800, 9, False), (18, 20, 20, False)]
)
def test_share_of_many_independent_cases_is_shown_with_few_vehicle_days(hits, n, vehicle_days, is_shown):
    holds = np.random.default_rng(3).permutation(np.arange(n) < hits)
    share = hold_share(holds, np.arange(n) % vehicle_days)
    assert format_share(share).startswith("92.5 % (" if is_shown else "– (")


def test_result_in_words_says_how_far_off_and_whether_the_interval_holds(result):
    off, held = describe_result(result)
    group = result.overall.hours["2"]
    assert off.startswith("2 h before the end of a shift, forecasts of the charge at its end were off by ")
    assert f" {group.mae_pct.value:.2f} ± " in off
    assert f"{100 * group.coverage.low:.1f} to {100 * group.coverage.high:.1f}" in held
    shown = " ".join(printed(result).split())
    assert f"{off} {held}" in shown
    assert shown.count("n: number of forecasts.") == 1


def test_fan_of_example_ends_at_end_of_shift(result):
    for shift in result.examples:
        upper, lower, mean, _, became = report.draw_example(shift).data
        assert became.y == (shift.soc_end_pct,)
        assert all(low <= m <= high for low, m, high in zip(lower.y, mean.y, upper.y, strict=True))


def test_few_short_shifts_are_shown_as_far_as_known(tmp_path):
    result = evaluate_soc(*FEW)
    out = printed(result)
    assert [row.name for row in tabulate_by_time(result).rows] == ["0 h", "all"]
    assert " 0 h " in out
    write_report(report.build_report(result), tmp_path / "few.html")
    assert "figure-soc-scatter" not in read_page((tmp_path / "few.html").read_text()).ids


def test_unusual_names_are_shown_unchanged(tmp_path):
    tables = [table.replace({"taxi-1": ODD, "nissan-leaf-2016": ODD}) for table in SMALL]
    result = evaluate_soc(*tables)
    assert "R&D's" in printed(result)
    assert any("no official rating is known of" in note for note in result.notes)
    write_report(report.build_report(result), tmp_path / "odd.html")
    assert "<b>R&D" not in (tmp_path / "odd.html").read_text()
