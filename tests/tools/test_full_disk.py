"""A command that fills the disk leaves what was there; any shortage is one line."""

import errno
import os

import pytest

from socast.core.errors import SettingsError
from socast.tools.simulator.car_files import CarWriter
from tests.support.commands import done, refused
from tests.support.paths import RECORDINGS

SIMULATE = "simulate", "--vehicles", 1, "--shift-hours", 0.25, "-o"


@pytest.mark.parametrize("place", ["scratch", "recording"])
def test_full_disk_leaves_the_recording_and_gives_one_line(place, tmp_path, capsys, monkeypatch):
    path = tmp_path / "shift.mcap"
    done(*SIMULATE, path)
    capsys.readouterr()
    before = path.read_bytes()

    def refuse(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(*((CarWriter, "write", refuse) if place == "scratch" else (os, "fsync", refuse)))
    assert "No space left on device; make room" in refused(capsys, *SIMULATE, path)
    assert path.read_bytes() == before
    assert {each.name for each in tmp_path.iterdir()} == {"shift.mcap", "shift.truth.json"}


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (OSError(errno.EMFILE, "Too many open files"), "Too many open files: the limit of open files is too low"),
        (OSError(errno.ENOSPC, "No space left on device"), "a disk is full: No space left on device; make room"),
        (MemoryError(), "memory is used up (no more is given): free some, or read fewer recordings"),
        (SettingsError("x" * 1_000_000), "xxx ... xxx"),
    ],
)
def test_shortage_is_one_line_of_bounded_length(monkeypatch, capsys, error, words):
    def fail(*_, **__):
        raise error

    monkeypatch.setattr("socast.tools.cli.application", lambda _: fail)
    message = refused(capsys, "info", "a.mcap")
    assert words in message
    assert len(message) < 2100


@pytest.mark.parametrize("command", [SIMULATE, ("replay", RECORDINGS / "shift.mcap", "-o")])
def test_output_that_is_a_circle_of_links_or_in_no_folder_is_refused_before_any_work(tmp_path, capsys, command):
    (tmp_path / "circle.mcap").symlink_to("circle.mcap")
    assert "circle.mcap cannot be written: File exists" in refused(capsys, *command, tmp_path / "circle.mcap")
    assert "a.mcap cannot be written: No such file" in refused(capsys, *command, tmp_path / "absent" / "a.mcap")
