"""A state file is replaced whole, keeps the state before the last one, and falls back to it loudly."""

import logging
import os
from pathlib import Path

import pytest

from socast.core.errors import SettingsError, SocastError
from socast.stream.state_file import DAMAGED, PREVIOUS, StateFile


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "cars.state"


def restore(snapshot: bytes) -> str:
    """Return the content of a snapshot; refuse a damaged one, as a pipeline does."""
    if b"damaged" in snapshot:
        raise SocastError(f"{snapshot.decode()} is no state")
    return snapshot.decode()


def save(path: Path, *states: bytes) -> None:
    with StateFile(path) as file:
        for state in states:
            file.save(state)


def test_state_that_was_saved_last_is_loaded(path):
    with StateFile(path) as file:
        assert not file.exists
        file.save(b"first")
        file.save(b"second")
        assert file.exists
        assert file.load(restore) == "second"
        assert (file.loaded, file.failure) == (path, "")


def test_second_name_holds_the_state_before_the_last_one(path):
    save(path, b"first")
    assert not path.with_name(path.name + PREVIOUS).exists()
    save(path, b"second", b"third")
    assert path.with_name(path.name + PREVIOUS).read_bytes() == b"second"


def test_damaged_state_falls_back_to_the_one_before_and_says_why(path):
    save(path, b"first", b"damaged")
    with StateFile(path) as file:
        assert file.load(restore) == "first"
        assert file.loaded == path.with_name(path.name + PREVIOUS)
        assert file.failure == f"{path}: damaged is no state"


def test_file_that_keeps_a_damaged_state_is_named_once_in_the_log(path, caplog):
    save(path, b"first", b"damaged")
    with caplog.at_level(logging.INFO, "socast.state"), StateFile(path) as file:
        file.load(restore)
        file.save(b"third")
        file.save(b"fourth")
    (record,) = caplog.records
    assert record.levelno == logging.WARNING
    assert record.fields == {"file": f"{path}{DAMAGED}"}


def test_damaged_state_never_replaces_the_one_before(path):
    save(path, b"first", b"damaged")
    with StateFile(path) as file:
        file.load(restore)
        file.save(b"third")
        assert path.with_name(path.name + PREVIOUS).read_bytes() == b"first"
        assert path.with_name(path.name + DAMAGED).read_bytes() == b"damaged"
        file.save(b"fourth")
    assert path.with_name(path.name + PREVIOUS).read_bytes() == b"third"
    assert path.read_bytes() == b"fourth"


def test_failed_save_leaves_the_state_before_a_damaged_one(path, monkeypatch):
    replace = Path.replace

    def refuse_fresh(self, target):
        if self.name.endswith(".new"):
            raise OSError(28, "No space left on device")
        return replace(self, target)

    save(path, b"first", b"damaged")
    with StateFile(path) as file:
        file.load(restore)
        with monkeypatch.context() as disk:
            disk.setattr(Path, "replace", refuse_fresh)
            with pytest.raises(SettingsError):
                file.save(b"third")
        file.save(b"fourth")
        assert path.with_name(path.name + PREVIOUS).read_bytes() == b"first"
        assert path.read_bytes() == b"fourth"


def test_missing_state_falls_back_to_the_one_before(path):
    save(path, b"first", b"second")
    path.unlink()
    with StateFile(path) as file:
        assert file.exists
        assert file.load(restore) == "first"
        assert file.failure == f"{path} does not exist"


def test_two_damaged_states_are_refused_with_the_failure_of_the_last_one(path):
    save(path, b"damaged first", b"damaged second")
    with (
        StateFile(path) as file,
        pytest.raises(
            SocastError,
            match=r"damaged second is no state; .*previous cannot be used either: restore a copy, or move both away$",
        ),
    ):
        file.load(restore)


def test_state_that_cannot_be_read_is_refused_by_name(path):
    path.mkdir()
    with StateFile(path) as file, pytest.raises(SettingsError, match=r"cars.state cannot be read: Is a directory$"):
        file.load(restore)


def test_missing_state_is_refused_by_name(path):
    with StateFile(path) as file, pytest.raises(SettingsError, match=r"cars.state does not exist$"):
        file.load(restore)


def test_disk_that_refuses_a_state_leaves_both_states(path, monkeypatch):
    def refuse(_: int) -> None:
        raise OSError(28, "No space left on device")

    with StateFile(path) as file:
        file.save(b"first")
        file.save(b"second")
        monkeypatch.setattr(os, "fsync", refuse)
        with pytest.raises(SettingsError, match=r"cars.state cannot be written: No space left on device;"):
            file.save(b"third")
        assert file.load(restore) == "second"
    assert path.with_name(path.name + PREVIOUS).read_bytes() == b"first"


def test_remains_of_a_crash_do_not_hinder_the_next_state(path):
    save(path, b"first")
    path.with_name(f".{path.name}.new").write_bytes(b"torn")
    path.with_name(f".{path.name}.link").write_bytes(b"torn")
    save(path, b"second")
    assert [path.read_bytes(), path.with_name(path.name + PREVIOUS).read_bytes()] == [b"second", b"first"]


def test_second_user_of_a_state_file_is_refused(path):
    with StateFile(path), pytest.raises(SettingsError, match=r"cars.state is in use by process"):
        StateFile(path)
