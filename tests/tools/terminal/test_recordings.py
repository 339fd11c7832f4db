"""Every command opens each recording once and refuses duplicates, even under different names."""

import json
from pathlib import Path
from shutil import copyfile
from types import SimpleNamespace

import pytest

from socast.core.errors import RecordingError, SettingsError
from socast.tools.terminal.recordings import QUIET_S, open_recordings, show_progress
from tests.support.commands import done, refused
from tests.support.paths import ROOT

SHIFT = ROOT / "recordings" / "shift.mcap"
AUTUMN = SHIFT.with_name("autumn.mcap")
COMMANDS = {
    "evaluate-soc": (SHIFT, SHIFT),
    "info": (SHIFT, SHIFT),
    "replay": ("--in-process", SHIFT, SHIFT),
    "replay --warm-up": ("--in-process", AUTUMN, "--warm-up", SHIFT, "--warm-up", SHIFT),
    "tables": (SHIFT, SHIFT, "--out", "{tmp}"),
    "compare": (SHIFT, SHIFT, "--model", "extended_physical", "--model", "basic_physical"),
}


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_refuses_recording_given_twice(command, tmp_path, capsys):
    given = [str(argument).replace("{tmp}", str(tmp_path)) for argument in COMMANDS[command]]
    assert f"{SHIFT} is given twice" in refused(capsys, command.split()[0], *given)


def test_same_recording_under_other_name_is_refused(tmp_path, monkeypatch):
    link = tmp_path / "link.mcap"
    link.symlink_to(SHIFT)
    monkeypatch.chdir(SHIFT.parent)
    for other in (link, Path("shift.mcap"), Path("..") / SHIFT.parent.name / "shift.mcap"):
        with pytest.raises(SettingsError, match=r"shift\.mcap is given twice|link\.mcap is given twice"):
            open_recordings([SHIFT, AUTUMN, other])


def test_different_recordings_are_opened_together(tmp_path):
    copy = tmp_path / "shift.mcap"
    copyfile(SHIFT, copy)
    assert [source.path for source in open_recordings([SHIFT, AUTUMN, copy])] == [SHIFT, AUTUMN, copy]


def test_circular_links_are_reported_in_one_line(tmp_path):
    one, other = tmp_path / "one.mcap", tmp_path / "other.mcap"
    one.symlink_to(other)
    other.symlink_to(one)
    with pytest.raises(RecordingError, match="cannot be read"):
        open_recordings([one, SHIFT])


def test_single_recording_is_read(tmp_path):
    done("info", SHIFT, "--json", tmp_path / "result.json")
    assert json.loads((tmp_path / "result.json").read_text())


def test_progress_in_a_pipe_is_a_rare_line(capsys):
    source, times = SimpleNamespace(blocks=80, blocks_read=0), iter([0.0, 1.0, QUIET_S, QUIET_S + 1.0, 2 * QUIET_S])
    with show_progress([source], words="learning", clock=lambda: next(times)) as step:
        for read in (1, 40, 41, 80):
            source.blocks_read = read
            step()
    assert capsys.readouterr().err == "learning: 40 of 80 chunks\nlearning: 80 of 80 chunks\n"


def test_hidden_progress_prints_nothing_in_a_pipe(capsys):
    source, times = SimpleNamespace(blocks=80, blocks_read=0), iter([0.0, 2 * QUIET_S])
    with show_progress([source], shown=False, clock=lambda: next(times)) as step:
        step()
    assert capsys.readouterr().err == ""
