"""JSON reports hold their format, go to standard output for `-`, and are written even if the reader has gone."""

import json
import subprocess

import pytest
import typer

from socast.core.wire.messages import Message
from socast.stream.mcap_writer import McapSink
from socast.tools.cli import CLOSED_PIPE, COMMANDS, application
from socast.tools.terminal.output import REPORT_VERSIONS, write_json
from tests.support.commands import SOCAST, called, done, refused
from tests.support.paths import SHIFT


def test_every_json_report_has_version():
    for name in COMMANDS:
        command = typer.main.get_command(application(name)).commands[name]
        if any(parameter.name == "json_file" for parameter in command.params):
            assert name in REPORT_VERSIONS, name


def test_report_starts_with_its_format_and_writes_nan_as_null(tmp_path):
    write_json(tmp_path / "x.json", "info", {"recordings": [float("nan")]})
    report = json.loads((tmp_path / "x.json").read_text())
    assert list(report) == ["format", "recordings"]
    assert report == {"format": {"report": "info", "version": 1}, "recordings": [None]}


@pytest.mark.parametrize("call", [("effects", "list"), ("effects", "show", "rolling"), ("info", SHIFT)])
def test_dash_prints_only_report_on_standard_output(call, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    done(*call, "--json", "-")
    printed = capsys.readouterr()
    assert json.loads(printed.out)["format"]["version"] == 1
    assert printed.err.strip()
    assert not list(tmp_path.iterdir())


def test_page_cannot_go_to_standard_output(capsys):
    assert "--html is '-'" in refused(capsys, "compare", SHIFT, "--model", "basic_physical", "--html", "-")


def test_report_is_written_after_reader_of_output_has_gone(tmp_path):
    with subprocess.Popen(
        [*SOCAST, "effects", "list", "--json", str(tmp_path / "x.json")], stdout=subprocess.PIPE, stderr=subprocess.PIPE
    ) as process:
        process.stdout.close()
        errors = process.stderr.read()
        assert process.wait(60) == CLOSED_PIPE
    assert errors == b""
    assert json.loads((tmp_path / "x.json").read_text())["format"]["report"] == "effects"


@pytest.mark.parametrize("command", [["info"], ["replay"], ["tables", "--out", "made"]], ids=lambda words: words[0])
def test_recording_without_usable_message_is_refused_in_one_line(command, tmp_path):
    path = tmp_path / "lunch.mcap"
    with McapSink(path) as sink:
        sink.put([Message("kitchen/lunch", b"{}", 1)])
    words = [str(tmp_path / word) if word == "made" else word for word in command]
    _, errors, code = called(*words, path)
    assert code == 2
    assert errors.count("\n") == 1
    assert "no message that socast can read" in errors


def test_fit_without_recipe_recommends_one_and_lists_all(tmp_path, capsys):
    message = refused(capsys, "fit", tmp_path, "-o", tmp_path / "m.json")
    assert "start with --recipe road_load" in message
    assert "pooled_hybrid" in message
