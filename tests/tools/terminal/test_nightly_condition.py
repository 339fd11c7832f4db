"""The condition of the cars of a night: its files, its bound, and the levels that metrics hold."""

import json

import pandas as pd
import pytest

from socast.core.errors import SettingsError
from socast.core.models import EXTENDED_PHYSICAL
from socast.tools.terminal import night_watch
from socast.tools.terminal.night_watch import name_condition_files, read_condition, write_condition
from tests.support.commands import called, refused

pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def rides(autumn_tables):
    return pd.read_parquet(autumn_tables / "rides.parquet")


def test_files_stand_beside_the_findings(tmp_path):
    data, page = name_condition_files(tmp_path / "findings.json")
    assert (data.name, page.name) == ("findings-condition.json", "findings-condition.html")
    assert data.parent == tmp_path


def test_written_levels_are_read_again(rides, tmp_path):
    data, page = name_condition_files(tmp_path / "findings.json")
    assert read_condition(data) is None
    assert write_condition(data, rides, EXTENDED_PHYSICAL) == 5
    assert "Condition of the cars" in page.read_text(encoding="utf-8")
    known = read_condition(data)
    cars = {car["vehicle_id"]: car for car in json.loads(data.read_text())["cars"]}
    assert not any(car["consumption"]["dates"] for car in cars.values())
    assert known.assessed_s == data.stat().st_mtime
    assert set(known.cars) == set(cars)
    for name, level in known.cars.items():
        assert level.consumption_ratio == pytest.approx(1.0 + cars[name]["consumption"]["level_pct"] / 100.0)
    usable = {name: level.usable_kwh for name, level in known.cars.items() if level.usable_kwh is not None}
    assert all(20.0 < each < 30.0 for each in usable.values())
    assert usable


def test_only_the_last_year_is_assessed(rides, tmp_path, monkeypatch):
    monkeypatch.setattr(night_watch, "MOST_DATES", 30)
    write_condition(tmp_path / "c.json", rides, EXTENDED_PHYSICAL)
    found = json.loads((tmp_path / "c.json").read_text())
    assert (found["first_date"], found["last_date"]) == ("2018-11-20", "2018-12-19")


@pytest.mark.parametrize("text", ["{}", "[", '{"cars": [{"vehicle_id": 1}]}'])
def test_file_that_is_no_condition_is_refused_in_one_line(tmp_path, text):
    (tmp_path / "c.json").write_text(text)
    with pytest.raises(SettingsError, match="is no condition of cars") as caught:
        read_condition(tmp_path / "c.json")
    assert "\n" not in str(caught.value)


def test_diagnosis_writes_the_condition_too(autumn_tables, tmp_path):
    words = "diagnose", autumn_tables, "--model", EXTENDED_PHYSICAL.name, "--findings", tmp_path / "f.json"
    printed, errors, code = called(*words, "--condition", tmp_path / "f-condition.json")
    assert code == 0, errors
    assert "condition of 5 cars in" in printed
    assert len(read_condition(tmp_path / "f-condition.json").cars) == 5


def test_too_few_dates_leave_the_diagnosis_alone(shift_tables, tmp_path):
    words = "diagnose", shift_tables, "--model", EXTENDED_PHYSICAL.name, "--condition", tmp_path / "c.json"
    printed, errors, _ = called(*words)
    assert "no condition of the cars: the rides are of 1 date" in " ".join(printed.split()), errors
    assert not (tmp_path / "c.json").exists()


def test_page_is_no_file_of_data(autumn_tables, tmp_path, capsys):
    words = "diagnose", autumn_tables, "--model", EXTENDED_PHYSICAL.name, "--condition", tmp_path / "c.html"
    assert "name a file that ends in .json" in refused(capsys, *words)
