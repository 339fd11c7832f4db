"""Save the state of a pipeline at an interval, and continue from the last state and the recording after it."""

import logging
import time
from collections.abc import Callable, Sequence
from typing import Any, Final, TypeVar

import msgspec

from socast.core.errors import SettingsError, SocastError
from socast.core.forecast.forecast_table import KEY_END
from socast.core.forecast.soc_filter import SHIFT_GAP
from socast.core.formatting import format_time
from socast.core.pipeline import Pipeline
from socast.core.wire.messages import Message
from socast.stream.idle_keys import IdleKeys
from socast.stream.loop import Tally, feed
from socast.stream.recorder import Place, Recorder
from socast.stream.state_file import StateFile
from socast.stream.structured_log import event_fields

SAVE_S: Final = 30.0
"""Time between two states. [s]"""

FORECASTS: Final = "forecasts"
"""Name of the newest forecasts in the note of a state."""
T = TypeVar("T")

_log = logging.getLogger("socast.state")


class Checkpoints:
    """Keep the state of a pipeline and the newest forecasts in a file, as a watch and a sink of the loop.

    A state on disk names its place in the recording, and every sample that it holds is on disk before it. After a
    crash, `restore` therefore finds every recorded sample, and none twice. What came from the caches of publishers is
    synced to disk at once, because these forget it: a consumer that is killed again and again soon after its start
    would otherwise ask for it until it is gone.

    Parameters
    ----------
    recorder : Recorder, optional
        Recorder of the messages. Without it, samples that came after the last state are only in the caches of
        publishers.
    clock : callable
        Function that returns monotonic time. [s]

    Attributes
    ----------
    caught_up : int
        Number of messages that `restore` took from the recording.
    saved_s : float
        Monotonic time of the last state. [s]
    """

    def __init__(
        self,
        pipeline: Pipeline,
        file: StateFile,
        recorder: Recorder | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.caught_up = 0
        self.saved_s = self._tried_s = clock()
        self._pipeline, self._file, self._recorder, self._clock = pipeline, file, recorder, clock
        self._recovered = 0
        self._newest: dict[str, Message] = {}
        self._keys = IdleKeys(SHIFT_GAP, clock)

    def restore(self) -> list[Message]:
        """Continue from the last state, then from what was recorded after it; save, and return the newest forecasts."""
        if self._file.exists:
            note = self._file.load(self._pipeline.restore)
            forecasts = note.pop(FORECASTS, []) if isinstance(note, dict) else []
            self.put(self._read(forecasts, list[Message], "its forecasts are none"))
            if self._recorder is not None and note:
                self._catch_up(self._recorder, note)
            self._log_start()
        self.save()
        return list(self._newest.values())

    def put(self, messages: Sequence[Message]) -> None:
        """Keep the newest forecast of each car that was not silent for so long that its shift is over."""
        forecasts = {message.key: message for message in messages if message.key.endswith(KEY_END)}
        self._newest.update(forecasts)
        for key in self._keys.use(forecasts):
            del self._newest[key]

    def close(self) -> None:
        """Do nothing: who stops the service saves the state."""

    def __call__(self, tally: Tally) -> None:
        """Sync what came from caches, and save the state when it is due; log if it cannot be saved."""
        if self._recorder is not None and tally.recovered > self._recovered:
            self._recovered = tally.recovered
            self._recorder.sync()
        if self._clock() - self._tried_s < SAVE_S:
            return
        try:
            self.save()
        except SettingsError as error:
            self._tried_s = self._clock()
            _log.error("state not kept: %s", error)

    def save(self) -> None:
        """Sync the recording to disk, then replace the state."""
        note: dict[str, Any] = {FORECASTS: list(self._newest.values())}
        if self._recorder is not None:
            self._recorder.sync()
            note |= msgspec.to_builtins(self._recorder.place)
        self._file.save(self._pipeline.snapshot(note))
        self.saved_s = self._tried_s = self._clock()

    def _log_start(self) -> None:
        """Log what the service continues from; loudly where it is not the last state."""
        file = self._file
        fields: dict[str, Any] = {"file": str(file.loaded), "vehicles": self._pipeline.quality()["vehicles"]}
        if self._recorder is not None:
            fields["caught_up"] = self.caught_up
        if not file.failure or file.loaded is None:
            _log.info("restored", extra=event_fields(**fields))
            return
        saved = format_time(file.loaded.stat().st_mtime)
        fields |= {"saved": saved, "reason": file.failure}
        if self._recorder is None:
            fields["lost"] = "what came after this state, because --record is not given"
        _log.error("restored from the state before the last one", extra=event_fields(**fields))

    def _catch_up(self, recorder: Recorder, note: Any) -> None:
        """Take what was recorded after the state, and keep the newest forecasts."""
        place = self._read(note, Place, "its place in the recording is no place")
        for messages in feed(recorder.read_after(place), self._pipeline, close=False):
            self.caught_up += len(messages)
            self.put(self._pipeline.forecasts(newest_only=True))

    def _read(self, value: Any, form: type[T], fault: str) -> T:
        """Return a part of the note of the state in its form."""
        try:
            return msgspec.convert(value, form)
        except msgspec.ValidationError as error:
            raise SocastError(f"{self._file.path}: {fault}: {error}") from error
