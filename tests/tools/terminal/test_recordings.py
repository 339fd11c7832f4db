"""Every command opens each recording once and refuses duplicates, even under different names."""

import json
from pathlib import Path
from shutil import copyfile

import pytest

from socast.core.errors import RecordingError, SettingsError
from socast.tools.terminal.recordings import open_recordings
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
