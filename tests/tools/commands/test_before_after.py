"""`socast before-after` answers in words, as JSON and as a page, and refuses wrong calls in one line."""

import json
import re
from pathlib import Path
from types import SimpleNamespace

import pytest

from socast.core.errors import SettingsError
from socast.tools.commands.before_after import read_spans
from socast.tools.report.before_after import _find_range
from tests.support.commands import called, done, refused
from tests.support.html_pages import assert_axes_are_titled, read_figures, read_page
from tests.support.paths import RECORDINGS

pytestmark = pytest.mark.long
MODEL = ("--model", "extended_physical")
SINCE = ("--vehicles", "taxi-005", "--at", "2018-11-10")


@pytest.fixture(scope="module")
def tables(tmp_path_factory) -> Path:
    """Tables of the autumn, in which a known effect was put into one car since a date."""
    folder = tmp_path_factory.mktemp("brakes")
    spiked = folder / "spiked.mcap"
    options = ("--effect", "brake_drag", "--size", "12%", "--vehicles", "taxi-005", "--since", "2018-11-10")
    done("spikein", RECORDINGS / "autumn.mcap", *options, "-o", spiked)
    done("tables", spiked, "--out", folder / "tables")
    return folder / "tables"


@pytest.fixture(scope="module")
def answer(tables):
    """Return what the command prints, its JSON report and its page."""
    files = tables / "result.json", tables / "page.html"
    outputs = ("--json", files[0], "--html", files[1])
    text, _, code = called("before-after", tables, *MODEL, *SINCE, "--what", "<new> brakes", *outputs)
    assert code == 0
    return " ".join(text.split()), json.loads(files[0].read_text()), files[1].read_text()


def test_effect_that_was_put_in_is_told_in_words(answer):
    text, result, _ = answer
    assert "taxi-005 takes" in text
    assert "% more since 10 November 2018 (<new> brakes): 90 % interval" in text
    assert f"of {len(result['placebo']['campaigns'])} placebo campaigns show" in text
    assert "To see" not in text
    assert re.search(r"At the [\d.]+ kWh/100 km of the days after, it makes \+[\d.]+ kWh/100 km \(\+[\d.]+ to ", text)


def test_interval_of_the_report_holds_the_effect(answer):
    _, result, _ = answer
    assert result["format"] == {"report": "before-after", "version": 1}
    low, high = result["change"]["ci90"]
    assert 0.0 < low < 0.12 < high
    assert result["cars"] == [result["change"]]
    assert result["at"] == "2018-11-10"


def test_page_shows_the_days_and_the_placebo_campaigns(answer):
    page = answer[2]
    reader = read_page(page)
    assert not reader.loaded
    assert {"figure-days-0", "figure-placebo"} <= set(reader.ids)
    assert "<new> brakes" in " ".join(reader.text)
    for figure in read_figures(page).values():
        assert_axes_are_titled(figure)


def test_no_day_of_the_figure_is_cut_by_its_edge(answer):
    figure = read_figures(answer[2])["figure-days-0"]
    low, high = figure["layout"]["yaxis"]["range"]
    room = 0.02 * (high - low)
    days = [y for trace in figure["data"] if trace.get("mode") == "markers" for y in trace["y"]]
    assert days
    assert all(y < low or low + room < y < high - room or y > high for y in days)


def test_car_without_the_effect_shows_no_change(tables):
    text = " ".join(called("before-after", tables, *MODEL, "--vehicles", "taxi-002", "--at", "2018-11-10")[0].split())
    assert "No change of taxi-002 is shown since 10 November 2018:" in text
    assert re.search(r"To see (even )?\d+ % ", text)


def test_date_to_come_tells_how_long_a_change_takes_to_be_seen(tables):
    later = called("before-after", tables, *MODEL, "--vehicles", "taxi-002", "--at", "2019-01-10", "--plan", "20%")[0]
    assert "The rides end on 19 December 2018, before 10 January 2019: nothing can be compared yet." in later
    assert "20 % takes about" in " ".join(later.split())
    planned = called("before-after", tables, *MODEL, "--vehicles", "taxi-002", "--plan", "20%")[0]
    assert "nothing can be compared yet" in planned


def test_days_on_of_a_file_are_compared_with_days_off(tables, tmp_path):
    file = tmp_path / "on.csv"
    file.write_text("vehicle_id,from,to\ntaxi-005,2018-11-10,\ntaxi-002,2018-10-10,2018-11-20\n")
    text = " ".join(called("before-after", tables, *MODEL, "--toggle", file, "--what", "eco mode")[0].split())
    assert "taxi-005 and taxi-002" in text
    assert "on days on (eco mode)" in text


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--vehicles", "taxi-05", "--at", "2018-11-10"), "did you mean taxi-005"),
        (("--vehicles", "taxi-005", "--at", "2018-09-01"), "the rides are of 2018-10-01 to 2018-12-19"),
        (("--vehicles", "taxi-005", "--at", "2018-12-16"), "3 days with measurements after the date"),
        (("--vehicles", "taxi-005", "--at", "10.11."), "--at is '10.11.'; give a date such as"),
        (("--vehicles", "taxi-005"), "is missing (--at)"),
        (("--at", "2018-11-10"), "not named (--vehicles)"),
        ((*SINCE, "--until", "2018-11-01"), "--until is 2018-11-01, and must be after --at, 2018-11-10"),
        ((*SINCE, "--toggle", "on.csv"), "--at is given with --toggle"),
        ((*SINCE, "--plan", "70%"), "the size is '70%'"),
        ((*SINCE, "--days", "3"), "--days is '3', must be greater than or equal to 5"),
        (("--vehicles", "taxi-005", "--at", "2018-12-10", "--days", "5"), "give more than 5 days (--days), more rides"),
    ],
)
def test_wrong_call_is_refused_in_one_line(tables, capsys, options, words):
    assert words in refused(capsys, "before-after", tables, *MODEL, *options)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("car,start,end\na,2018-11-10,\n", "its header must be vehicle_id,begin,end, or begin,end with --vehicles"),
        ("from,to\n2018-11-10,\n", "has no column vehicle_id, and no cars are named: give them with --vehicles"),
        ("vehicle_id,begin,end\na,2018-11-10,2018-11-01\n", "line 2: the end 2018-11-01 is before the begin"),
        ("vehicle_id,begin,end\na,10 Nov,\n", "line 2: begin is '10 Nov'; give a date"),
        ("vehicle_id,begin,end\n", "holds no days on of any car"),
    ],
)
def test_wrong_file_of_days_on_is_refused_with_its_line(tmp_path, content, words):
    file = tmp_path / "on.csv"
    file.write_text(content)
    with pytest.raises(SettingsError, match=words):
        read_spans(file)


def test_days_on_without_vehicles_are_those_of_all_cars(tmp_path):
    file = tmp_path / "on.csv"
    file.write_text("begin,end\n2018-11-10,2018-11-12\n")
    assert [each.vehicle_id for each in read_spans(file, ("a", "b"))] == ["a", "b"]


def test_figure_of_days_that_are_all_far_from_their_levels_shows_the_levels():
    path = SimpleNamespace(level=[0.1])
    low, high = _find_range([SimpleNamespace(deviation=[0.0] * 9 + [10.0], level_before=path, level_after=path)])
    assert low <= 10.0 <= high
