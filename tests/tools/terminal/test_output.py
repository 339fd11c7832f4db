"""Commands refuse outputs that would overwrite an input or another output."""

from pathlib import Path

import pytest

from socast.core.errors import SettingsError
from socast.tools.terminal.output import PIPE_WIDTH, check_outputs, make_console, select_model_files


@pytest.mark.parametrize("name", ["model.json", "./model.json"])
def test_model_file_that_is_input_is_not_overwritten(tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "model.json").write_text("{}")
    with pytest.raises(SettingsError, match=r"is read and would be overwritten"):
        check_outputs(select_model_files(["road_load.json", "basic_physical", "model.json"]), Path(name))
    assert select_model_files(["basic_physical"]) == []


def test_same_file_for_two_outputs_is_refused(tmp_path):
    with pytest.raises(SettingsError, match="written twice"):
        check_outputs([], tmp_path / "a.json", tmp_path / "." / "a.json")


@pytest.mark.parametrize(("columns", "width"), [("60", 60), ("", PIPE_WIDTH), ("wide", PIPE_WIDTH)])
def test_width_of_tables_in_a_pipe_follows_columns(columns, width, monkeypatch):
    monkeypatch.setenv("COLUMNS", columns)
    assert make_console().width == width
