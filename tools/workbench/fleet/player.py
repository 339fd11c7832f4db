"""The player of recordings: play, pause, speed and seek, with the pipeline of `socast replay`.

Snapshots of the pipeline are kept at intervals. A seek back returns to the last one before its goal and runs on from
there. The state after a seek equals that of an uninterrupted run, to the bit, because any division of the messages
gives the same results.
"""

import logging
import shlex
import time
from bisect import bisect_right
from collections.abc import Callable, Iterator, Mapping, Sequence
from math import inf, isinf
from operator import attrgetter
from pathlib import Path
from threading import Condition, Thread
from typing import Any, Final, NamedTuple

import numpy as np

from socast.core.errors import SettingsError, SocastError
from socast.core.pipeline import Pipeline
from socast.core.wire.message_block import MessageBlock
from socast.core.wire.messages import Message, Outlook
from socast.core.wire.plan_checks import parse_leg, parse_vehicle
from socast.stream.loop import feed
from socast.stream.mcap_reader import McapSource
from socast.stream.source import merge_sources
from socast.tools.terminal.live_table import add_predictions, make_ride_records
from socast.tools.workbench.fleet.board import Board, BoardState
from socast.tools.workbench.fleet.ride_parts import compute_ride_parts

BLOCK: Final = 2000
"""Largest number of messages that the pipeline takes while pages wait."""
BLOCK_BYTES: Final = 1_000_000
"""Size of their payloads from which it takes no more, because a batch holds thousands of samples. [B]"""
STEP_S: Final = 0.05
"""Time between two steps of the player. [s]"""
RIDES_S: Final = 1.0
"""Time between two looks for rides that have ended. [s]"""
LONGEST_GAP_S: Final = 60.0
"""Length of recorded time to which the player shortens a silence of the whole fleet. [s]"""
MOST_CHECKPOINTS: Final = 32
"""Number of checkpoints from which every second one is dropped."""
FIRST_INTERVAL_S: Final = 300.0
"""Recorded time between two checkpoints, until there are many. [s]"""
FIRST_SPEED: Final = 60.0
"""Speed at the beginning, relative to real time. [1]"""
LONG_SPEED: Final = 300.0
"""The same for recordings longer than `LONG_S`. [1]"""
LONG_S: Final = 12.0 * 3600.0
"""Length from which a recording is played at `LONG_SPEED`. [s]"""
FASTEST: Final = 100_000.0
"""Largest speed that a page may choose, beside as fast as possible. [1]"""
_log = logging.getLogger("socast.workbench")


class Checkpoint(NamedTuple):
    """Hold the state after a number of messages.

    Parameters
    ----------
    time_ns : int
        Time of receipt of the last of them. [ns]
    """

    messages: int
    time_ns: int
    pipeline: bytes
    board: BoardState


class Player:
    """Replay recordings to a board, as a page controls it.

    Parameters
    ----------
    make_pipeline : callable
        Function that returns a pipeline; its argument states whether to learn from earlier recordings first.
    command : sequence of str
        Words of the command that replays the same without a browser.
    advice : str
        What a better model would bring, empty for a fitted one.
    clock : callable
        Function that returns monotonic time. [s]

    Attributes
    ----------
    begin_ns, end_ns : int
        First and last time of receipt. [ns]
    """

    def __init__(
        self,
        recordings: Sequence[Path],
        make_pipeline: Callable[[bool], Pipeline],
        board: Board,
        command: Sequence[str] = (),
        advice: str = "",
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        spans = [span for path in recordings if (span := McapSource(path).span_ns)]
        if not spans:
            raise SettingsError(f"{recordings[0]} holds no message; give a recording of a fleet")
        self.begin_ns, self.end_ns = min(first for first, _ in spans), max(last for _, last in spans)
        self.board = board
        self._has_been_shown, self._command, self._advice = False, list(command), advice
        self._recordings, self._make_pipeline, self._clock = list(recordings), make_pipeline, clock
        self._changed = Condition()
        is_long = self.end_ns - self.begin_ns > LONG_S * 1e9
        self._speed, self._is_playing = LONG_SPEED if is_long else FIRST_SPEED, False
        self._goal_ns: int | None = None
        self._has_ended = self._is_begun = False
        self._position_ns, self._interval_s = self.begin_ns, FIRST_INTERVAL_S
        self._origin: tuple[float, int] | None = None
        self._problem = ""
        self._rides_due = 0.0
        self.pipeline: Pipeline | None = None
        self._checkpoints: list[Checkpoint] = []
        self._messages = _MessageReader(self._recordings)
        self._fed: Iterator[Sequence[Message]] = iter(())
        self._following_ns = self._messages.peek()
        self._thread = Thread(target=self._run, name="player", daemon=True)

    def start(self) -> None:
        """Start the thread of the player; it waits for `play`."""
        self._thread.start()

    def close(self) -> None:
        """End the thread."""
        with self._changed:
            self._has_ended = True
            self._changed.notify_all()
        if self._thread.is_alive():
            self._thread.join(10.0)

    def describe(self) -> dict[str, Any]:
        """Return the state of the player as a JSON record; times in Unix seconds."""
        at_end = self._following_ns is None and self._goal_ns is None and self._is_begun
        return {
            "mode": "replay",
            "recordings": [str(path) for path in self._recordings],
            "model": "" if self.pipeline is None else self.pipeline.context.model_label,
            "advice": self._advice,
            "begin_s": self.begin_ns * 1e-9,
            "end_s": self.end_ns * 1e-9,
            "time_s": round(self._position_ns * 1e-9, 3),
            "playing": self._is_playing and not at_end,
            "seeking": self._goal_ns is not None or not self._is_begun,
            "at_end": at_end,
            "problem": self._problem,
            "speed": None if isinf(self._speed) else self._speed,
            "command": shlex.join([*self._command, "--speed", "max" if isinf(self._speed) else f"{self._speed:g}"]),
        }

    def show(self) -> None:
        """Begin to play when a page shows the fleet for the first time, so that nothing was missed."""
        if not self._has_been_shown:
            self._has_been_shown = True
            self.play()

    def play(self) -> None:
        """Play on; at the end, from the beginning."""
        with self._changed:
            if self._following_ns is None and self._is_begun:
                self._goal_ns = self.begin_ns
            self._is_playing, self._origin = True, None
            self._changed.notify_all()

    def pause(self) -> None:
        """Pause."""
        with self._changed:
            self._is_playing = False
            self._changed.notify_all()

    def set_speed(self, speed: float) -> None:
        """Set the speed relative to real time; infinite is as fast as possible."""
        if not (0.0 < speed <= FASTEST or speed == inf):
            raise SettingsError(f"the speed is {speed:g}, must be above 0 and at most {FASTEST:,.0f}, or max")
        with self._changed:
            self._speed, self._origin = speed, None
            self._changed.notify_all()

    def seek(self, time_s: float) -> None:
        """Go to a time of the recording. [Unix s]"""
        time_ns = round(time_s * 1e9) if abs(time_s) < 1e11 else 0
        if not self.begin_ns - 10**9 <= time_ns <= self.end_ns + 10**9:
            raise SettingsError(f"the time {time_s:g} is outside the recording; choose one between its begin and end")
        with self._changed:
            self._goal_ns = min(max(time_ns, self.begin_ns), self.end_ns)
            self._changed.notify_all()

    def ask(self, vehicle_id: str, parameters: Mapping[str, str]) -> Outlook:
        """Return the outlook on the rest of a car's shift, as `socast ask` does.

        Parameters
        ----------
        parameters : mapping of str to str
            Fields of the ride that the question is about; empty for the shift as planned.
        """
        vehicle, leg = parse_vehicle(vehicle_id), parse_leg(parameters)
        with self.board.lock:
            if self.pipeline is None:
                raise SocastError("the player loads the recording; ask again in a moment")
            return self.pipeline.ask(vehicle, leg)

    def list_ask_options(self) -> None:
        """Return None: no command answers for a replay."""

    def get_parts(self, vehicle_id: str) -> dict[str, float] | None:
        """Return the predicted energy of the ride in progress by term of the model. [kWh]"""
        with self.board.lock:
            return None if self.pipeline is None else compute_ride_parts(self.pipeline, vehicle_id)

    def _run(self) -> None:
        """Begin, and follow the commands until the end."""
        try:
            self._begin()
            self.board.density.count_recordings(merge_sources([McapSource(path) for path in self._recordings]))
            while self._step():
                pass
        except SocastError as error:
            self._problem = " ".join(str(error).split())
            _log.error("the player stopped: %s", self._problem)
        except Exception:  # noqa: BLE001 - the pages stay open, and the log says why nothing moves
            self._problem = "a defect; see the log of `socast serve`"
            _log.exception("the player stopped by a defect")
        finally:
            self._fed = iter(())  # the loop before it ends now

    def _begin(self) -> None:
        """Make the pipeline, and keep the state before the first message."""
        pipeline = self._make_pipeline(True)
        with self.board.lock:
            self.pipeline = pipeline
            self._fed = feed(self._messages, pipeline, close=False)
            self._checkpoints = [Checkpoint(0, self.begin_ns, pipeline.snapshot(), self.board.dump())]
        self._is_begun = True

    def _step(self) -> bool:
        """Do what is due, and wait for the next step; return False at the end."""
        with self._changed:
            if self._has_ended:
                return False
            goal = self._goal_ns
            if goal is None and not (self._is_playing and self._following_ns is not None):
                self._changed.wait()
                return True
        if goal is not None:
            self._go(goal)
        elif not self._play_on():
            with self._changed:
                if not self._has_ended and self._goal_ns is None:
                    self._changed.wait(STEP_S)
        return True

    def _play_on(self) -> bool:
        """Take what has fallen due; return whether more is due at once."""
        if isinf(self._speed):
            return self._take(self.end_ns)
        now, following = self._clock(), self._following_ns
        if self._origin is None:
            self._origin = now, self._position_ns
        due_ns = self._origin[1] + round((now - self._origin[0]) * self._speed * 1e9)
        if following is not None and following - max(due_ns, self._position_ns) > LONGEST_GAP_S * 1e9:
            due_ns = following
            self._origin = now, following
        self._position_ns = min(max(due_ns, self._position_ns), self.end_ns)
        return self._take(due_ns)

    def _go(self, goal_ns: int) -> None:
        """Go to a time, unless another command comes first."""
        if goal_ns < self._position_ns:
            self._return_to(goal_ns)
        while self._goal_ns == goal_ns and not self._has_ended and self._take(goal_ns):
            pass
        if self._goal_ns == goal_ns:
            self._take_rides()
        with self._changed:
            if self._goal_ns == goal_ns:
                self._goal_ns, self._position_ns, self._origin = None, goal_ns, None

    def _return_to(self, time_ns: int) -> None:
        """Return to the last checkpoint at or before a time."""
        last = [each for each in self._checkpoints if each.time_ns <= time_ns or not each.messages][-1]
        pipeline = self._make_pipeline(False)
        pipeline.restore(last.pipeline)
        with self.board.lock:
            self.pipeline = pipeline
            self.board.load(last.board)
        self._messages = _MessageReader(self._recordings, last.messages)
        self._fed = feed(self._messages, pipeline, close=False)
        self._following_ns = self._messages.peek()
        self._position_ns = last.time_ns

    def _take(self, until_ns: int) -> bool:
        """Pass messages to the pipeline and the board; return whether more of them are due."""
        self._messages.until_ns = until_ns
        with self.board.lock:
            messages = next(self._fed, ())
            if messages and self.pipeline is not None:
                self.board.take(messages)
                self.board.take(self.pipeline.forecasts())
                self.pipeline.model_errors()
        if messages:
            self._position_ns = max(self._position_ns, messages[-1].receipt_ns)
            self._keep_checkpoint(messages[-1].receipt_ns)
        self._following_ns = self._messages.peek()  # last, so that the end is reported once its state is there
        if self._clock() >= self._rides_due:
            self._take_rides()
        return self._following_ns is not None and self._following_ns <= until_ns

    def _take_rides(self) -> None:
        """Move the rides that have ended from the pipeline to the board."""
        self._rides_due = self._clock() + RIDES_S
        if self.pipeline is not None:
            with self.board.lock:
                self.pipeline.take_windows()
                self.board.rides += make_ride_records(
                    add_predictions(self.pipeline.take_rides(), self.pipeline.shadows)
                )

    def _keep_checkpoint(self, time_ns: int) -> None:
        """Keep the state if the last one that was kept is old enough."""
        if self.pipeline is None or time_ns - self._checkpoints[-1].time_ns < self._interval_s * 1e9:
            return
        self._take_rides()
        with self.board.lock:
            state = self.pipeline.snapshot(), self.board.dump()
        self._checkpoints.append(Checkpoint(self._messages.count, time_ns, *state))
        if len(self._checkpoints) > MOST_CHECKPOINTS:
            self._checkpoints = [self._checkpoints[0], *self._checkpoints[2::2]]
            self._interval_s *= 2.0


class _MessageReader:
    """Yield the messages of recordings up to a time of receipt, which moves on, after a number of them."""

    def __init__(self, recordings: Sequence[Path], skip: int = 0) -> None:
        self.count, self.until_ns = skip, 0
        self._blocks: Iterator[Sequence[Message]] = merge_sources([McapSource(path) for path in recordings])
        self._block: Sequence[Message] = []
        self._at = 0
        while skip and self.peek() is not None:
            step = min(skip, len(self._block) - self._at)
            self._at, skip = self._at + step, skip - step

    def peek(self) -> int | None:
        """Return the time of receipt of the next message, None at the end. [ns]"""
        while self._at >= len(self._block):
            block = next(self._blocks, None)
            if block is None:
                return None
            self._block, self._at = block, 0
        return self._block[self._at].receipt_ns

    def __iter__(self) -> Iterator[Sequence[Message]]:
        """Yield the next messages that are due, up to `BLOCK` or the one that reaches `BLOCK_BYTES`, perhaps none."""
        while self.peek() is not None:
            stop = bisect_right(self._block, self.until_ns, lo=self._at, key=attrgetter("receipt_ns"))
            out = self._block[self._at : min(stop, self._at + BLOCK)]
            ends = np.cumsum(MessageBlock.of(out).columns.sizes)
            out = out[: int(np.searchsorted(ends, BLOCK_BYTES)) + 1]
            self._at += len(out)
            self.count += len(out)
            yield out
