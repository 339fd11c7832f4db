"""A command that fills the disk leaves what was there, and says so in one line."""

import errno
import os

import pytest

from socast.tools.simulator.car_files import CarWriter
from tests.support.commands import done, refused

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
