"""`socast condition` says in words, tables, JSON and a page how each car is doing."""

import json

import pandas as pd
import pytest

from socast.core.models import EXTENDED_PHYSICAL
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
