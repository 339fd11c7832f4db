"""`socast condition` says in words, tables, JSON and a page how each car is doing."""

import json
from datetime import date

import pandas as pd
import pytest
from msgspec.structs import replace

from socast.core.condition.records import CarCondition, CarEvent, Trend
from socast.core.models import EXTENDED_PHYSICAL, save
from socast.tools.report.condition import HEIGHT, ROW_PX, ROWS, Frame, draw_car
from tests.support.commands import called, done, refused
from tests.support.html_pages import assert_axes_are_titled, read_figures, read_page


@pytest.fixture(scope="module")
def slower(autumn_tables, tmp_path_factory):
    """Return the tables of the autumn, in which one car takes 40 % more from November on."""
    folder = tmp_path_factory.mktemp("slower")
    rides = pd.read_parquet(autumn_tables / "rides.parquet")
    more = (rides["vehicle_id"] == "taxi-002") & (rides["date"] >= "2018-11-10")
    for name in ("energy_kwh", "energy_vi_kwh"):
        rides.loc[more, name] *= 1.4
    rides.to_parquet(folder / "rides.parquet")
    pd.read_parquet(autumn_tables / "windows.parquet").to_parquet(folder / "windows.parquet")
    return folder


@pytest.fixture(scope="module")
def written(slower, tmp_path_factory):
    """Return the printed text, the JSON and the page of the condition."""
    folder = tmp_path_factory.mktemp("written")
    given = "--json", folder / "c.json", "--html", folder / "c.html"
    printed, _, code = called("condition", slower, "--model", EXTENDED_PHYSICAL.name, *given)
    assert code == 0
    return printed, json.loads((folder / "c.json").read_text(encoding="utf-8")), folder / "c.html"


def test_car_that_takes_more_is_first_and_dated_in_words(written):
    printed, result, _ = written
    first = result["cars"][0]
    assert first["vehicle_id"] == "taxi-002"
    low, high = first["consumption"]["steps"][0]["interval"]
    assert low <= "2018-11-10" <= high
    assert "taxi-002: takes " in printed
    assert " more (" in printed
    assert "than its siblings" in printed
    assert "November 2018" in printed


def test_report_has_a_row_and_a_figure_for_each_car(written):
    printed, result, page = written
    assert result["format"]["report"] == "condition"
    assert len(result["cars"]) == 5
    assert all(car["vehicle_id"] in printed for car in result["cars"])
    text = page.read_text(encoding="utf-8")
    read_page(text)
    figures = read_figures(text)
    assert len(figures) == 5
    for figure in figures.values():
        assert_axes_are_titled(figure)


@pytest.fixture(scope="module")
def known(slower, tmp_path_factory):
    """Return the printed text, the JSON and the page of the condition with known events."""
    folder = tmp_path_factory.mktemp("known")
    lines = [
        "2018-11-10,taxi-002,<brakes>",
        "2018-11-18,taxi-002,new tyres",
        "2018-11-21,taxi-004,",
        "2018-11-01,,update",
    ]
    (folder / "workshop.csv").write_text("\n".join(["date,vehicle_id,what", *lines, "2018-11-01,van,brakes"]))
    given = "--events", folder / "workshop.csv", "--json", folder / "c.json", "--html", folder / "c.html"
    printed, errors, code = called("condition", slower, "--model", EXTENDED_PHYSICAL.name, *given)
    assert code == 0, errors
    return " ".join(printed.split()), json.loads((folder / "c.json").read_text(encoding="utf-8")), folder / "c.html"


def test_model_has_the_name_that_the_user_gave(slower, tmp_path):
    save(EXTENDED_PHYSICAL, tmp_path / "mine.json")
    printed, _, code = called("condition", slower, "--model", tmp_path / "mine.json", "--html", tmp_path / "c.html")
    assert code == 0
    assert "model mine." in " ".join(printed.split())
    assert EXTENDED_PHYSICAL.name not in printed


def test_title_of_a_table_does_not_scroll_with_it(written):
    frames = written[2].read_text(encoding="utf-8").split('<div class="table">')[1:]
    assert frames[0].startswith('<p class="title">Cars, those with a finding first</p><div class="scroll"')
    assert not any("<caption>" in each for each in frames)


def test_known_events_are_told_in_the_words_of_their_cars(known):
    printed, result, _ = known
    since = result["cars"][0]["consumption"]["steps"][0]["since"]
    days = (date(2018, 11, 18) - date.fromisoformat(since)).days
    assert f"new tyres on 18 November 2018, {days} days after the step" in printed
    assert "with <brakes> on 10 November 2018" in printed
    assert "Known of taxi-004: event on 21 November 2018." in printed
    assert "Known of all cars: update on 1 November 2018." in printed
    assert "1 known event is of other cars, or outside the dates, and left out." in printed


def test_known_events_are_in_the_json(known):
    _, result, _ = known
    first = result["cars"][0]
    assert [each["what"] for each in first["events"]] == ["<brakes>", "new tyres"]
    assert [each["date"] for each in first["consumption"]["steps"][0]["events"]] == ["2018-11-10"]
    assert [each["what"] for each in result["events"]] == ["update"]
    assert result["events_left_out"] == 1


def test_known_events_are_marked_in_the_figures(known):
    _, result, page = known
    text = page.read_text(encoding="utf-8")
    read_page(text)
    figures = read_figures(text)
    first = figures["figure-car-0"]["layout"]
    assert {each["text"] for each in first["annotations"]} == {"<brakes>", "new tyres", "update"}
    days = {each["x0"] for each in first["shapes"] if each["x0"] == each["x1"]}
    assert days == {"2018-11-01", "2018-11-10", "2018-11-18"}
    place = [car["vehicle_id"] for car in result["cars"]].index("taxi-001")
    assert [each["text"] for each in figures[f"figure-car-{place}"]["layout"]["annotations"]] == ["update"]
    assert "Known events" in text


def test_figures_of_all_cars_have_the_same_axes_and_say_how_many_days_are_outside(written):
    _, result, page = written
    text = page.read_text(encoding="utf-8")
    layouts = [each["layout"] for each in read_figures(text).values()]
    assert len({tuple(layout["yaxis"]["range"]) for layout in layouts}) == 1
    low, high = layouts[0]["yaxis"]["range"]
    outside = {
        car["vehicle_id"]: sum(not low <= y <= high for y in car["consumption"]["measured_pct"])
        for car in result["cars"]
    }
    assert any(outside.values())
    assert all((f"Outside the figure: {number} day" in text) for number in outside.values() if number)


def test_event_of_a_step_is_told_once(known):
    printed, _, _ = known
    assert printed.count("<brakes> on 10 November 2018") == 1


def test_many_events_leave_room_for_the_figure():
    car = CarCondition(vehicle_id="a", vehicle_model="m", siblings=0)
    events = [CarEvent(date=f"2018-11-{day:02}", what="a long story of a repair") for day in range(1, 29)]
    figure = draw_car(replace(car, events=events), Frame("2018-11-01", "2018-11-30", None, None))
    lines = {shape.x0 for shape in figure.layout.shapes if shape.x0 == shape.x1}
    assert len(lines) == 28
    assert len(figure.layout.annotations) == ROWS
    assert figure.layout.height == HEIGHT + ROWS * ROW_PX


def test_level_is_no_dashed_line_as_the_reference_is():
    trend = Trend(
        days=2,
        level_pct=1.0,
        ci68_pct=(0.0, 2.0),
        ci95_pct=(-1.0, 3.0),
        rate_pct=None,
        rate_ci95_pct=None,
        is_changing=False,
        steps=[],
        dates=["2018-11-01", "2018-11-02"],
        measured_pct=[1.0, 1.0],
        path_pct=[1.0, 1.0],
        path_sd_pct=[1.0, 1.0],
    )
    car = CarCondition(vehicle_id="a", vehicle_model="m", siblings=0, consumption=trend, capacity=trend)
    figure = draw_car(car, Frame("2018-11-01", "2018-11-30", (-5.0, 5.0), (-20.0, 2.0)))
    dashes = {trace.line.dash for trace in figure.data if trace.mode == "lines"}
    assert figure.layout.shapes[0].line.dash not in dashes
    assert [axis.range for axis in figure.select_yaxes()] == [(-5.0, 5.0), (-20.0, 2.0)]


def test_file_without_events_is_refused_before_the_rides_are_read(slower, tmp_path, capsys):
    (tmp_path / "workshop.csv").write_text("day\n2018-11-01\n")
    message = refused(capsys, "condition", slower, "--model", "m.json", "--events", tmp_path / "workshop.csv")
    assert "no column 'date'" in message


def test_json_goes_to_a_pipe(slower):
    printed, told, code = called("condition", slower, "--model", EXTENDED_PHYSICAL.name, "--json", "-")
    assert code == 0
    assert json.loads(printed)["model"] == EXTENDED_PHYSICAL.name
    assert "taxi-002" in told


def test_recordings_of_too_few_dates_are_refused_in_one_line(shift_tables, capsys):
    message = refused(capsys, "condition", shift_tables, "--model", EXTENDED_PHYSICAL.name)
    assert "a condition takes 6: give more days" in message


def test_unknown_model_is_refused(autumn_tables, capsys):
    assert "nothing.json" in refused(capsys, "condition", autumn_tables, "--model", "nothing.json")


def test_help_names_the_question(capsys):
    done("condition", "--help")
    assert "since when" in capsys.readouterr().out
