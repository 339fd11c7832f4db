"""Findings are kept in a JSON file, and changes are printed with the commands that try them."""

import io
import json

import pytest
from rich.console import Console

from socast.core.errors import SettingsError
from socast.tools.terminal.night_watch import read_findings, show_changes, write_findings
from tests.support.findings import make_finding


def test_findings_are_unchanged_by_a_round_trip(tmp_path):
    file = tmp_path / "findings.json"
    assert read_findings(file) == []
    write_findings(file, [make_finding(), make_finding(who="taxi-006", share=None)])
    assert read_findings(file) == [make_finding(), make_finding(who="taxi-006", share=None)]
    assert json.loads(file.read_text())["format"] == {"report": "findings", "version": 1}
    assert list(tmp_path.iterdir()) == [file]


@pytest.mark.parametrize("content", ["", "{}", '{"findings": [1]}', "\xff"])
def test_file_that_holds_something_else_is_refused(tmp_path, content):
    (tmp_path / "findings.json").write_text(content)
    with pytest.raises(SettingsError, match="is no file of findings"):
        read_findings(tmp_path / "findings.json")


def test_file_that_cannot_be_replaced_is_one_error_and_leaves_nothing_behind(tmp_path):
    (tmp_path / "findings.json").mkdir()
    with pytest.raises(SettingsError, match="cannot be written: Is a directory"):
        write_findings(tmp_path / "findings.json", [make_finding()])
    assert [path.name for path in tmp_path.iterdir()] == ["findings.json"]


def test_changes_are_printed_with_their_commands():
    text = io.StringIO()
    show_changes([], [make_finding(), make_finding(who="taxi-006", status="gone")], Console(file=text, width=200))
    assert text.getvalue().splitlines() == [
        "Sure (97 %): taxi-005 uses 4.1 ± 0.9 % more",
        "socast add tyre_pressure",
        "socast live",
        "Gone: taxi-005 uses 4.1 ± 0.9 % more",
    ]
