"""`socast verify` tells how far the filters are from filterpy's, and exits with 1 where that is too far."""

import json
from math import log10

import pytest

from socast.stream.mcap_writer import McapSink
from socast.tools.report.verification import LEAST_DRAWN, build_report, describe
from socast.tools.verify import soc_witness
from socast.tools.verify.differences import Tallies
from socast.tools.verify.records import GOAL, Verification
from tests.support.commands import called, refused
from tests.support.html_pages import assert_axes_are_titled, read_figures, read_page
from tests.support.recorded_shift import shift


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    path = tmp_path_factory.mktemp("verify") / "shift.mcap"
    with McapSink(path, 20_000) as sink:
        sink.put(shift())
    return path


def test_report_says_how_many_steps_of_each_filter_and_car_were_compared(recording):
    out, _, code = called("verify", recording, "--json", "-")
    report = json.loads(out)
    assert code == 0
    assert report["format"] == {"report": "verify", "version": 1}
    for each in report["filters"]:
        assert each["meets_goal"] is True
        assert 0.0 <= each["mean"] <= report["goal"]
        assert each["steps"] == each["compared"] + sum(each["passed_over"].values())
        assert [car["vehicle_id"] for car in each["cars"]] == ["car-0", "car-1", "car-2"]
        assert sum(car["compared"] for car in each["cars"]) == each["compared"] > 0


def test_table_has_a_row_for_each_filter_and_cars_on_demand(recording):
    out, _, _ = called("verify", recording)
    assert "state of charge" in out
    assert "elevation of rides" in out
    assert "no difference exceeds the goal of 1e-09" in out
    assert "car-1" not in out
    assert "car-1" in called("verify", recording, "--cars")[0]


def test_missed_goal_is_told_with_exit_code_1(recording, monkeypatch):
    monkeypatch.setattr(soc_witness, "CONSUMPTION_WANDER", 1.001 * soc_witness.CONSUMPTION_WANDER)
    out, _, code = called("verify", recording)
    assert code == 1
    assert "exceeds the goal of 1e-09: state of charge." in out


def test_filter_without_a_compared_step_is_named():
    tallies = Tallies()
    tallies["car"].add((1e-12, 1e-13))
    both = [tallies.summarise("state of charge"), Tallies().summarise("elevation of rides")]
    assert (both[1].compared, both[1].mean, both[1].meets_goal) == (0, None, None)
    result = Verification(goal=GOAL, filters=both)
    assert result.meets_goal
    assert describe(result).endswith("Nothing could be compared: elevation of rides.")
    assert not Verification(goal=GOAL, filters=both[1:]).meets_goal


def test_recording_of_something_else_is_refused(tmp_path, capsys):
    path = tmp_path / "other.mcap"
    with McapSink(path, 20_000) as sink:
        sink.put([shift(1)[0]._replace(key="somewhere/else")])
    assert "no message that socast can read" in refused(capsys, "verify", path)


def test_page_shows_each_difference_beside_the_goal(recording, tmp_path):
    page, data = tmp_path / "v.html", tmp_path / "v.json"
    out, _, code = called("verify", recording, "--html", page, "--json", data)
    assert code == 0
    assert f"report in {page}" in " ".join(out.split())
    text = page.read_text(encoding="utf-8")
    read_page(text)
    assert text.count("car-1</th>") == 2  # a row of each filter, without --cars too
    (figure,) = read_figures(text).values()
    assert_axes_are_titled(figure)
    cars, largest = figure["data"]
    filters = json.loads(data.read_text(encoding="utf-8"))["filters"]
    values = [value for each in filters for value in (each["mean"], each["covariance"])]
    assert largest["x"] == [max(value, LEAST_DRAWN) for value in values]
    assert len(cars["x"]) == 3 * len(values)
    low, high = figure["layout"]["xaxis"]["range"]
    assert low < log10(LEAST_DRAWN) < log10(GOAL) < high
    assert figure["layout"]["annotations"][0]["x"] == log10(GOAL)


def test_page_without_a_compared_step_has_no_figure():
    result = Verification(goal=GOAL, filters=[Tallies().summarise("state of charge")])
    assert build_report(result).draw("filters") == []
