"""A lock keeps a second process out, names the process that holds it, and is free when that process ends."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from socast.core.errors import SettingsError
from socast.stream.file_lock import FileLock

HOLDER = """
import sys
from pathlib import Path
from socast.stream.file_lock import FileLock
lock = FileLock(Path(sys.argv[1]), "cars")
print("held", flush=True)
sys.stdin.read()
"""


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "lock"


def test_second_lock_is_refused_with_the_process_that_holds_the_first(file):
    with (
        FileLock(file, "cars"),
        pytest.raises(SettingsError, match=rf"^cars is in use by process {os.getpid()};"),
    ):
        FileLock(file, "cars")


def test_closed_lock_can_be_taken_again_and_its_file_remains(file):
    lock = FileLock(file, "cars")
    lock.close()
    lock.close()
    with FileLock(file, "cars"):
        pass
    assert file.read_text() == f"{os.getpid()}\n"


def test_killed_process_frees_its_lock(file):
    holder = subprocess.Popen(
        [sys.executable, "-c", HOLDER, file], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    try:
        assert holder.stdout
        assert holder.stdout.readline() == "held\n"
        with pytest.raises(SettingsError, match=rf"in use by process {holder.pid};"):
            FileLock(file, "cars")
    finally:
        holder.kill()
        holder.communicate()
    FileLock(file, "cars").close()


def test_longer_name_of_the_process_before_is_no_part_of_the_message(file):
    file.write_text("99999999999999\n")
    with FileLock(file, "cars"), pytest.raises(SettingsError, match=rf"by process {os.getpid()};"):
        FileLock(file, "cars")


def test_lock_in_a_missing_folder_is_refused(tmp_path):
    with pytest.raises(SettingsError, match=r"^cars cannot be written: No such file or directory;"):
        FileLock(tmp_path / "none" / "lock", "cars")
