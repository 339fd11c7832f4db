"""A consumer that crashes at a byte of the recording, or at a step of saving the state, continues as if it had not."""

import io
import os
import shutil
from collections import defaultdict
from collections.abc import Callable
from itertools import count, pairwise
from pathlib import Path

import pytest

from socast.core.pipeline import Pipeline
from socast.core.wire.messages import Message
from socast.stream import recorder, state_file
from socast.stream.checkpoints import Checkpoints
from socast.stream.mcap_reader import McapSource
from socast.stream.recorder import Recorder, list_recordings
from socast.stream.state_file import StateFile
from tests.support.faulty_shifts import decodable_shift

pytestmark = pytest.mark.long
CACHE = 64
"""Number of messages that caches deliver again after a crash."""
LIST = 16
"""Number of messages in a list from the source."""
SAVE = 5
"""Number of lists between two states."""


class Crash(BaseException):
    """The end of the process."""


class Consumer:
    """A consumer without Zenoh, whose files can be left as a crash leaves them."""

    def __init__(self, folder: Path) -> None:
        self.recorder = Recorder(folder / "kept", file_bytes=20_000, flush_s=1e-9)
        self.file = StateFile(folder / "cars")
        self.pipeline = Pipeline()
        self.checkpoints = Checkpoints(self.pipeline, self.file, self.recorder)
        try:
            self.forecasts = self.checkpoints.restore()
        except Crash:
            self.free_locks()
            raise

    def take(self, messages: list[Message]) -> None:
        """Take messages list by list, and save the state now and then."""
        for number, start in enumerate(range(0, len(messages), LIST)):
            self.pipeline.take(messages[start : start + LIST], self.recorder.put)
            self.forecasts += self.pipeline.forecasts()
            if number % SAVE == SAVE - 1:
                self.checkpoints.save()

    def free_locks(self) -> None:
        """Free the locks, as the operating system does."""
        self.recorder._lock.close()
        self.file.close()


@pytest.fixture(scope="module")
def sent() -> list[Message]:
    once = {(m.key, m.payload): m for m in reversed(decodable_shift(5))}
    return [m._replace(receipt_ns=1_700_000_000 * 10**9 + i) for i, m in enumerate(reversed(once.values()))]


@pytest.fixture(scope="module")
def expected(sent: list[Message]) -> tuple[set[Message], bytes]:
    pipeline = Pipeline()
    return set(pipeline.push(sent)), pipeline.snapshot()


class CrashedFolders:
    """Copies of the folder of a running consumer, each as the end of its process at a time would leave it.

    Parameters
    ----------
    parent : Path
        Folder of the folders.
    """

    def __init__(self, parent: Path) -> None:
        self.folder = parent / "running"
        self.folder.mkdir()
        self.given = 0
        self.copies: defaultdict[str, list[tuple[Path, int]]] = defaultdict(list)

    def add(self, name: str) -> None:
        """Copy the folder, under the name of a moment, with how many messages the consumer had been given."""
        copies = self.copies[name]
        copies.append((self.folder.with_name(f"{name}-{len(copies)}"), self.given))
        shutil.copytree(self.folder, copies[-1][0])

    def run(self, sent: list[Message]) -> None:
        """Run a consumer to its end."""
        consumer = Consumer(self.folder)
        for start in range(0, len(sent), LIST * SAVE):
            self.given = min(start + LIST * SAVE, len(sent))
            consumer.take(sent[start : self.given])
        consumer.recorder.close()
        consumer.free_locks()


def assert_continues(folder: Path, sent: list[Message], given: int, expected: tuple[set[Message], bytes]) -> None:
    """Assert that a new consumer, to which caches deliver messages again, ends as an uninterrupted one."""
    consumer = Consumer(folder)
    consumer.take(sent[max(0, given - LIST * SAVE - CACHE) :])
    consumer.recorder.close()
    consumer.free_locks()
    kept = [m for path in list_recordings(folder / "kept") for messages in McapSource(path) for m in messages]
    assert [(m.key, m.payload) for m in kept] == [(m.key, m.payload) for m in sent]
    assert set(consumer.forecasts) <= expected[0]
    assert consumer.pipeline.snapshot() == expected[1]


class WatchedFile:
    """A file that reaches the disk at once; the folders are copied at each thousandth byte of all such files."""

    def __init__(self, path: Path, written: list[int], crashed: CrashedFolders) -> None:
        self._file, self._written, self._crashed = io.FileIO(path, "wb"), written, crashed

    def write(self, data: bytes) -> int:
        rest = memoryview(data)
        while len(rest) > (left := 1000 - self._written[0] % 1000):
            self._write(rest[:left])
            self._crashed.add("byte")
            rest = rest[left:]
        self._write(rest)
        return len(data)

    def _write(self, data: memoryview) -> None:
        self._written[0] += self._file.write(data)

    def __getattr__(self, name: str) -> object:
        return getattr(self._file, name)


def open_watched(crashed: CrashedFolders) -> Callable[..., object]:
    """Return a replacement of `Path.open` that watches what is written to recordings."""
    plain, written = Path.open, [0]

    def choose(path: Path, mode: str = "r", *arguments: object, **named: object) -> object:
        if path.suffix == ".mcap" and "w" in mode:
            return WatchedFile(path, written, crashed)
        return plain(path, mode, *arguments, **named)

    return choose


def test_crash_at_each_thousandth_byte_of_the_recording(tmp_path, monkeypatch, sent, expected):
    crashed = CrashedFolders(tmp_path)
    with monkeypatch.context() as disk:
        disk.setattr(Path, "open", open_watched(crashed))
        crashed.run(sent)
    for folder, given in crashed.copies["byte"]:
        assert_continues(folder, sent, given, expected)
        shutil.rmtree(folder)
    assert len(crashed.copies["byte"]) > 20


_STEPS: list[tuple[object, str]] = [
    (os, "fsync"),
    (os, "link"),
    (state_file, "sync"),
    (Path, "replace"),
    (os, "fdatasync"),
]


def make_crash(owner: object, name: str, number: int, *, before: bool) -> Callable[..., object]:
    """Return a replacement of a function that ends the process before or after one of its calls."""
    genuine: Callable[..., object] = getattr(owner, name)
    calls = count()

    def crash(*arguments: object) -> object:
        now = next(calls) == number
        if now and before:
            raise Crash
        result = genuine(*arguments)
        if now:
            raise Crash
        return result

    return crash


def copy_at_calls(crashed: CrashedFolders, owner: object, name: str) -> Callable[..., object]:
    """Return a replacement of a function that copies the folders before and after some of its calls."""
    genuine: Callable[..., object] = getattr(owner, name)
    calls = count()

    def call(*arguments: object) -> object:
        chosen = next(calls) in {0, 1, 2, 5, 9}
        if chosen:
            crashed.add(f"{name}-before")
        result = genuine(*arguments)
        if chosen:
            crashed.add(f"{name}-after")
        return result

    return call


@pytest.fixture(scope="module")
def crashed_at_steps(tmp_path_factory, sent: list[Message]) -> dict[str, list[tuple[Path, int]]]:
    """Return what crashes before and after the steps of saving the state leave of one run."""
    crashed = CrashedFolders(tmp_path_factory.mktemp("steps"))
    with pytest.MonkeyPatch.context() as disk:
        for owner, name in _STEPS:
            disk.setattr(owner, name, copy_at_calls(crashed, owner, name))
        crashed.run(sent)
    return crashed.copies


@pytest.mark.parametrize("when", ["before", "after"])
@pytest.mark.parametrize("step", [name for _, name in _STEPS])
def test_crash_at_each_step_of_saving_the_state(sent, expected, crashed_at_steps, step, when):
    copies = crashed_at_steps[f"{step}-{when}"]
    for folder, given in copies:
        assert_continues(folder, sent, given, expected)
    assert len(copies) >= 2


@pytest.fixture(scope="module")
def damaged(tmp_path_factory, sent: list[Message]) -> tuple[Path, int]:
    """Give the files of a consumer whose last state is damaged, and how many messages it had been given."""
    folder, given = tmp_path_factory.mktemp("damaged"), 4 * LIST * SAVE
    consumer = Consumer(folder)
    consumer.take(sent[:given])
    consumer.recorder.close()
    consumer.free_locks()
    content = consumer.file.path.read_bytes()
    consumer.file.path.write_bytes(content[: len(content) // 2])
    return folder, given


@pytest.mark.parametrize("before", [True, False], ids=["before", "after"])
@pytest.mark.parametrize("step", range(len(_STEPS)), ids=[name for _, name in _STEPS])
def test_crash_at_each_step_of_replacing_a_damaged_state(tmp_path, monkeypatch, sent, expected, damaged, step, before):
    owner, name = _STEPS[step]
    crashes = 0
    for number in range(3):
        folder = tmp_path / str(number)
        shutil.copytree(damaged[0], folder)
        with monkeypatch.context() as disk:
            disk.setattr(owner, name, make_crash(owner, name, number, before=before))
            try:
                Consumer(folder).free_locks()
            except Crash:
                crashes += 1
        assert (folder / "cars.previous").exists()
        assert_continues(folder, sent, damaged[1], expected)
        assert (folder / "cars.damaged").read_bytes() == (damaged[0] / "cars").read_bytes()
    assert crashes or name == "fdatasync", "a start writes nothing to the recording"


def test_every_truncated_recording_is_read_to_its_last_whole_chunk(tmp_path, sent):
    kept = Recorder(tmp_path / "kept", flush_s=1e-9)
    for start in range(0, 64, 8):
        kept.put(sent[start : start + 8])
    kept.close()
    (path,) = kept.files
    whole, numbers = path.read_bytes(), []
    for size in range(0, len(whole), 97):
        path.write_bytes(whole[:size])
        again = Recorder(tmp_path / "kept")
        read = [m for messages in again.read_after(recorder.Place("", 0)) for m in messages]
        again.close()
        assert read == sent[: len(read)]
        numbers.append(len(read))
    assert all(a <= b for a, b in pairwise(numbers))
    assert numbers[-1] == 64
