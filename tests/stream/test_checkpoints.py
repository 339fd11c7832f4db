"""Checkpoints save the state behind the recording, and continue from both."""

import logging
import shutil
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import pytest

from socast.core.errors import SettingsError, SocastError
from socast.core.wire.messages import Message
from socast.stream.checkpoints import SAVE_S, Checkpoints
from socast.stream.loop import Tally
from socast.stream.recorder import Recorder
from socast.stream.state_file import StateFile

SENT = [Message(f"fleet/{'ab'[n % 2]}/telemetry", b"%d" % n, n) for n in range(12)]


class Taken:
    """A pipeline whose state is the list of payloads that it took; each payload calls for a forecast."""

    def __init__(self) -> None:
        self.payloads: list[str] = []
        self._due: list[Message] = []

    def take(self, messages, record=None) -> None:
        if record:
            record(messages)
        self.payloads += [message.payload.decode() for message in messages]
        self._due += [message._replace(key=message.key.replace("telemetry", "forecast")) for message in messages]

    def forecasts(self, *, newest_only: bool = False) -> list[Message]:
        due, self._due = self._due, []
        return list({message.key: message for message in due}.values()) if newest_only else due

    def model_errors(self, **_: Any) -> list[Message]:
        return []

    def finish(self) -> list[Message]:
        return []

    def quality(self) -> dict[str, Any]:
        return {"vehicles": 2}

    def snapshot(self, note: Any = None) -> bytes:
        return msgspec.json.encode([self.payloads, note])

    def restore(self, snapshot: bytes) -> Any:
        if snapshot == b"damaged":
            raise SocastError("damaged is no state")
        self.payloads, note = msgspec.json.decode(snapshot)
        return note


@pytest.fixture
def service(tmp_path: Path) -> Iterator[SimpleNamespace]:
    """Give a function that starts a consumer with the files of the test; it ends the one before."""
    running: list[SimpleNamespace] = []

    def stop() -> None:
        for each in running:
            each.recorder.close()
            each.file.close()
        running.clear()

    def start() -> SimpleNamespace:
        stop()
        made = SimpleNamespace(
            pipeline=Taken(), file=StateFile(tmp_path / "cars"), recorder=Recorder(tmp_path / "kept"), now=0.0
        )
        made.checkpoints = Checkpoints(made.pipeline, made.file, made.recorder, clock=lambda: made.now)
        running.append(made)
        return made

    yield SimpleNamespace(start=start, state=tmp_path / "cars")
    stop()


def payloads(messages: list[Message]) -> list[str]:
    return [message.payload.decode() for message in messages]


def test_first_start_saves_an_empty_state(service):
    consumer = service.start()
    assert consumer.checkpoints.restore() == []
    assert consumer.file.load(Taken().restore) == {"forecasts": [], "file": "", "messages": 2**53}


def test_start_continues_from_the_state_and_then_from_what_was_recorded_after_it(service):
    first = service.start()
    first.checkpoints.restore()
    first.pipeline.take(SENT[:4], first.recorder.put)
    first.checkpoints.save()
    first.pipeline.take(SENT[4:9], first.recorder.put)
    second = service.start()
    forecasts = second.checkpoints.restore()
    assert second.pipeline.payloads == payloads(SENT[:9])
    assert second.checkpoints.caught_up == 5
    assert payloads(forecasts) == ["8", "7"]


def test_each_further_start_without_new_messages_publishes_the_newest_forecasts_again(service):
    first = service.start()
    first.checkpoints.restore()
    first.pipeline.take(SENT[:4], first.recorder.put)
    for _ in range(3):
        assert payloads(service.start().checkpoints.restore()) == ["2", "3"]


def test_forecast_of_a_car_that_was_silent_for_a_whole_gap_is_not_published_again(service):
    first = service.start()
    first.checkpoints.restore()
    for first.now, key in ((0.0, "fleet/a/forecast"), (7000.0, "fleet/b/forecast"), (7300.0, "models/m/1/errors")):
        first.checkpoints.put([Message(key, b"1", 0)])
    first.checkpoints.save()
    assert [message.key for message in service.start().checkpoints.restore()] == ["fleet/b/forecast"]


def test_start_from_the_state_before_a_damaged_one_says_how_far_the_recording_caught_up(service, caplog):
    first = service.start()
    first.checkpoints.restore()
    for part in (SENT[:4], SENT[4:7], SENT[7:9]):
        first.pipeline.take(part, first.recorder.put)
        if part[0] is not SENT[7]:
            first.checkpoints.save()
    service.state.write_text("damaged")
    second = service.start()
    with caplog.at_level(logging.INFO, "socast.state"):
        second.checkpoints.restore()
    assert second.pipeline.payloads == payloads(SENT[:9])
    start, kept = (line for line in caplog.records if line.name == "socast.state")  # whatever the level of others
    assert start.levelno == logging.ERROR
    assert (start.fields["file"], start.fields["caught_up"]) == (f"{service.state}.previous", 5)
    assert "damaged is no state" in start.fields["reason"]
    assert kept.fields == {"file": f"{service.state}.damaged"}


def test_second_start_takes_nothing_twice(service):
    first = service.start()
    first.checkpoints.restore()
    first.pipeline.take(SENT, first.recorder.put)
    service.start().checkpoints.restore()
    third = service.start()
    third.checkpoints.restore()
    assert third.pipeline.payloads == payloads(SENT)
    assert third.checkpoints.caught_up == 0


def test_recording_is_on_disk_before_the_state_that_holds_it(service):
    consumer = service.start()
    consumer.pipeline.take(SENT, consumer.recorder.put)
    place = consumer.recorder.place
    consumer.checkpoints.save()
    note = consumer.file.load(Taken().restore)
    assert note.pop("forecasts") == []
    assert note == msgspec.to_builtins(consumer.recorder.place) != msgspec.to_builtins(place)
    assert note["messages"] == len(SENT)


def test_copies_of_the_files_of_a_running_consumer_start_another_one(service, tmp_path):
    consumer = service.start()
    consumer.pipeline.take(SENT[:5], consumer.recorder.put)
    consumer.checkpoints.save()
    shutil.copy(tmp_path / "cars", tmp_path / "copy")
    consumer.pipeline.take(SENT[5:], consumer.recorder.put)
    consumer.recorder.sync()
    shutil.copytree(tmp_path / "kept", tmp_path / "kept-copy")
    with StateFile(tmp_path / "copy") as file:
        other, recorder = Taken(), Recorder(tmp_path / "kept-copy")
        Checkpoints(other, file, recorder).restore()
        recorder.close()
    assert other.payloads == payloads(SENT)


def test_state_is_saved_at_an_interval_by_the_clock(service):
    consumer = service.start()
    consumer.checkpoints.restore()
    consumer.pipeline.take(SENT)
    consumer.now = SAVE_S - 0.1
    consumer.checkpoints(Tally())
    kept = Taken()
    consumer.file.load(kept.restore)
    assert kept.payloads == []
    consumer.now = SAVE_S
    consumer.checkpoints(Tally())
    consumer.file.load(kept.restore)
    assert kept.payloads == payloads(SENT)
    assert consumer.checkpoints.saved_s == SAVE_S


def test_what_came_from_caches_is_on_disk_at_once(service, monkeypatch):
    consumer = service.start()
    consumer.checkpoints.restore()
    consumer.pipeline.take(SENT[:5], consumer.recorder.put)
    consumer.checkpoints(Tally(received=5))
    assert consumer.recorder.place.file == ""
    consumer.checkpoints(Tally(received=5, recovered=2))
    assert consumer.recorder.place.messages == 5
    monkeypatch.setattr(consumer.recorder, "sync", lambda: pytest.fail("nothing else came from a cache"))
    consumer.checkpoints(Tally(received=7, recovered=2))


def test_state_that_the_disk_refuses_is_logged_and_tried_again_after_the_interval(service, monkeypatch, caplog):
    consumer = service.start()
    consumer.checkpoints.restore()
    saved_s = consumer.checkpoints.saved_s
    tries: list[bytes] = []

    def refuse(snapshot: bytes) -> None:
        tries.append(snapshot)
        raise SettingsError("the disk is full")

    monkeypatch.setattr(consumer.file, "save", refuse)
    for consumer.now in (SAVE_S, 1.5 * SAVE_S, 2 * SAVE_S):
        with caplog.at_level(logging.ERROR, "socast.state"):
            consumer.checkpoints(Tally())
    assert len(tries) == 2
    assert [record.getMessage() for record in caplog.records] == ["state not kept: the disk is full"] * 2
    assert consumer.checkpoints.saved_s == saved_s, "the age of the state grows"


def test_state_without_a_recording_continues_without_one(tmp_path):
    with StateFile(tmp_path / "cars") as file:
        pipeline = Taken()
        pipeline.take(SENT)
        Checkpoints(pipeline, file).save()
        again = Taken()
        assert Checkpoints(again, file).restore() == []
    assert again.payloads == payloads(SENT)


def test_place_that_is_none_is_refused(service):
    consumer = service.start()
    consumer.file.save(Taken().snapshot({"file": 7}))
    with pytest.raises(SocastError, match="its place in the recording is no place"):
        consumer.checkpoints.restore()
