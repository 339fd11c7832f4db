"""A file has its old content or its new content, whatever the disk does, and a failure is one line."""

import os
import resource
import signal
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from socast.core import models
from socast.core.cleaning.elevation_map import ElevationPlaces
from socast.core.errors import SocastError
from socast.core.files import refuse_beyond_memory, replacing, write_whole
from socast.core.wire.messages import Message
from socast.stream.elevation_files import write_places
from socast.stream.mcap_writer import replace_recording
from socast.stream.state_file import StateFile
from socast.tools.terminal.night_watch import write_findings
from socast.tools.terminal.output import write_file, write_json
from socast.tools.terminal.table_files import ParquetTable

OLD = b"the content before"


@contextmanager
def full_disk(left):
    """Refuse to write more bytes than this to a file, as a full disk does, though with another reason."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (left, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def write_state(path):
    with StateFile(path) as file:
        file.save(b"x" * 1000)


def write_table(path):
    with ParquetTable(path) as table:
        for _ in range(3):
            table.append(pd.DataFrame({"ride": ["a"] * 1000, "x": np.random.default_rng(1).random(1000)}))


def write_recording(path):
    with replace_recording(path) as sink:
        sink.put([Message("fleet/a/telemetry", b"{}", 1)])


def write_map(path):
    zero, one = np.zeros(1, np.int64), np.ones(1)
    write_places(ElevationPlaces(1e-5, 1e-5, zero, zero, one, one, one), path)


WRITERS = {
    "model": lambda path: models.save(models.load("extended_physical"), path),
    "JSON": lambda path: write_json(path, "tables", {"rides": [{"ride": "x" * 1000}]}),
    "findings": lambda path: write_findings(path, []),
    "page": lambda path: write_file(path, b"x" * 1000),
    "state": write_state,
    "table": write_table,
    "map of elevation": write_map,
    "recording": write_recording,
}


@pytest.mark.parametrize("name", WRITERS)
@pytest.mark.parametrize("left", [0, 50])
def test_full_disk_leaves_the_old_file_and_gives_one_line(tmp_path, name, left):
    path = tmp_path / "kept"
    path.write_bytes(OLD)
    with full_disk(left), pytest.raises(SocastError, match="File too large") as failure:
        WRITERS[name](path)
    assert path.read_bytes() == OLD
    assert "\n" not in str(failure.value)
    assert {file.name for file in tmp_path.iterdir()} <= {"kept", ".kept.lock"}


@pytest.mark.parametrize("name", WRITERS)
def test_new_content_takes_the_place_of_the_old(tmp_path, name):
    path = tmp_path / "kept"
    path.write_bytes(OLD)
    WRITERS[name](path)
    assert path.read_bytes() != OLD
    assert {file.name for file in tmp_path.iterdir()} <= {"kept", ".kept.lock", "kept.previous"}


@pytest.mark.parametrize("refused", ["fsync", "write"])
def test_disk_that_refuses_anything_leaves_the_old_file(tmp_path, monkeypatch, refused):
    path = tmp_path / "model.json"
    path.write_bytes(OLD)

    def refuse(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(*((os, "fsync", refuse) if refused == "fsync" else ("pathlib.Path.write_bytes", refuse)))
    with pytest.raises(OSError, match="No space left"):
        write_whole(path, b"new")
    assert path.read_bytes() == OLD
    assert list(tmp_path.iterdir()) == [path]


def test_content_is_on_disk_before_the_name_and_the_name_before_the_end(tmp_path, monkeypatch):
    done, sync, replace = [], os.fsync, type(tmp_path).replace
    monkeypatch.setattr(
        os, "fsync", lambda number: (done.append(str(Path(f"/proc/self/fd/{number}").readlink())), sync(number))
    )
    monkeypatch.setattr("pathlib.Path.replace", lambda *both: (done.append("rename"), replace(*both))[1])
    write_whole(tmp_path / "a", b"new")
    assert [done[0].endswith(".new"), *done[1:]] == [True, "rename", str(tmp_path)]


def test_what_killed_processes_left_is_removed_by_the_next_writer_of_the_same_file(tmp_path):
    with subprocess.Popen(["true"]) as ended:
        pass
    left, other, running = (
        tmp_path / name for name in (f".a.{ended.pid}.new", f".b.{ended.pid}.new", f".a.{os.getppid()}.new")
    )
    for path in (left, other, running):
        path.write_bytes(b"half")
    write_whole(tmp_path / "a", b"new")
    assert {path.name for path in tmp_path.iterdir()} == {"a", other.name, running.name}


def test_writer_that_is_killed_amid_writing_leaves_the_old_file(tmp_path):
    path = tmp_path / "model.json"
    path.write_bytes(OLD)
    script = f"""
import os, signal
from pathlib import Path
from socast.core.files import replacing
with replacing(Path({str(path)!r})) as fresh:
    fresh.write_bytes(b"half")
    os.kill(os.getpid(), signal.SIGKILL)
"""
    assert subprocess.run([sys.executable, "-c", script], check=False).returncode == -signal.SIGKILL
    assert path.read_bytes() == OLD
    assert len(list(tmp_path.iterdir())) == 2
    write_whole(path, b"new")
    assert list(tmp_path.iterdir()) == [path]


def test_table_beyond_the_memory_is_refused_by_what_its_file_says(tmp_path):
    refuse_beyond_memory(tmp_path / "rides.parquet", 1_000_000, 100)
    with pytest.raises(SocastError, match="1,000,000,000,000 rows of 100 columns, about 800,000 GB, above the"):
        refuse_beyond_memory(tmp_path / "rides.parquet", 10**12, 100)


def test_exception_of_the_writer_leaves_the_old_file(tmp_path):
    path = tmp_path / "table"
    path.write_bytes(OLD)

    def stop_halfway():
        with replacing(path) as fresh:
            fresh.write_bytes(b"half")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        stop_halfway()
    assert path.read_bytes() == OLD
    assert list(tmp_path.iterdir()) == [path]


def test_link_stays_a_link_and_permissions_stay(tmp_path):
    (tmp_path / "folder").mkdir()
    path, link = tmp_path / "folder" / "model.json", tmp_path / "current.json"
    path.write_bytes(OLD)
    path.chmod(0o640)
    link.symlink_to(path)
    write_whole(link, b"new")
    assert link.is_symlink()
    assert (path.read_bytes(), path.stat().st_mode & 0o777) == (b"new", 0o640)


def test_new_file_has_the_permissions_of_any_new_file(tmp_path):
    (tmp_path / "plain").write_bytes(b"")
    write_whole(tmp_path / "whole", b"")
    assert (tmp_path / "whole").stat().st_mode == (tmp_path / "plain").stat().st_mode


def test_pipe_is_written_and_not_replaced(tmp_path):
    os.mkfifo(path := tmp_path / "pipe")
    reader = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
    try:
        write_whole(path, b"new")
        assert os.read(reader, 10) == b"new"
    finally:
        os.close(reader)
    assert path.is_fifo()


def test_file_that_must_not_be_written_is_refused(tmp_path, monkeypatch):
    path = tmp_path / "model.json"
    path.write_bytes(OLD)
    monkeypatch.setattr(os, "access", lambda *_: False)  # the superuser may write whatever its mode
    with pytest.raises(PermissionError):
        write_whole(path, b"new")
    assert path.read_bytes() == OLD


def test_name_may_be_as_long_as_a_folder_allows(tmp_path):
    write_whole(path := tmp_path / ("é" * 127), b"new")
    assert path.read_bytes() == b"new"


def test_folder_and_missing_folder_are_refused(tmp_path):
    with pytest.raises(IsADirectoryError):
        write_whole(tmp_path, b"new")
    with pytest.raises(FileNotFoundError):
        write_whole(tmp_path / "none" / "a", b"new")
