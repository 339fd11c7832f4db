"""The options of `socast live` for its recording and for the limits of what it takes in, and the warning of these."""

import logging
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Final

import typer

from socast.core.pipeline import Pipeline
from socast.core.settings import BOUNDS_OF_LIMITS, LIVE_KEY_RATE, Limits
from socast.stream.recorder import FILE_BYTES, FILE_S, FLUSH_S, Recorder
from socast.stream.structured_log import event_fields
from socast.tools.terminal.option_groups import insert_options


@dataclass(frozen=True)
class RecordingOptions:
    """Hold where and how messages are recorded.

    Parameters
    ----------
    folder : Path, optional
        Folder of the files; None records nothing.
    file_bytes : int
        Size at which the next file begins. [B]
    file_s : float
        Longest time span of a file. [s]
    flush_s : float
        Longest time until a received message is synced to disk. [s]
    """

    folder: Path | None = None
    file_bytes: int = FILE_BYTES
    file_s: float = FILE_S
    flush_s: float = FLUSH_S

    def open_recorder(self, metadata: Mapping[str, str]) -> Recorder | None:
        """Return a recorder that holds the lock of the folder; None if nothing is recorded."""
        if self.folder is None:
            return None
        return Recorder(self.folder, self.file_bytes, self.file_s, self.flush_s, metadata=metadata)


def make_recording_options(
    *,
    record: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Record every payload as it came, decodable or not.")
    ] = None,
    record_mb: Annotated[
        float, typer.Option(metavar="MB", help="Size at which the next file begins.", min=0.001, max=1e6)
    ] = FILE_BYTES / 2**20,
    record_minutes: Annotated[
        float, typer.Option(metavar="MIN", help="Time span of a file.", min=0.001, max=1e6)
    ] = FILE_S / 60,
    flush: Annotated[
        float,
        typer.Option(metavar="S", help="Longest time until a received message is synced to disk.", min=0.001, max=1e6),
    ] = FLUSH_S,
) -> RecordingOptions:
    """Return the values of the options."""
    return RecordingOptions(record, round(record_mb * 2**20), record_minutes * 60, flush)


insert_recording_options = insert_options("recording", make_recording_options, "Recording")
"""Decorator that gives a command the options of the recording in place of its argument `recording`."""

_DEFAULTS: Final = Limits()
_log = logging.getLogger("socast.live")


def _option(name: str, field: str, metavar: str, words: str) -> Any:
    """Return an option with the bounds of a limit."""
    low, high = BOUNDS_OF_LIMITS[field]
    return typer.Option(name, metavar=metavar, help=words, min=low, max=high)


def make_limits(
    max_vehicles: Annotated[
        int, _option("--max-vehicles", "vehicles", "N", "Ignore new vehicles beyond this number.")
    ] = int(_DEFAULTS.vehicles),
    max_stations: Annotated[
        int, _option("--max-stations", "stations", "N", "Ignore new weather stations beyond this number.")
    ] = int(_DEFAULTS.stations),
    max_models: Annotated[
        int, _option("--max-models", "vehicle_models", "N", "Ignore new vehicle models beyond this number.")
    ] = int(_DEFAULTS.vehicle_models),
    max_payload_bytes: Annotated[
        int, _option("--max-payload-bytes", "payload_bytes", "N", "Refuse larger payloads.")
    ] = int(_DEFAULTS.payload_bytes),
    max_queue_bytes: Annotated[
        int, _option("--max-queue-bytes", "queue_bytes", "N", "Let publishers wait while more is queued.")
    ] = int(_DEFAULTS.queue_bytes),
    max_list_samples: Annotated[
        int, _option("--max-list-samples", "list_samples", "N", "Refuse lists of more samples.")
    ] = int(_DEFAULTS.list_samples),
    max_key_rate: Annotated[
        float, _option("--max-key-rate", "key_rate", "HZ", "Refuse more messages a second under a key; 0 for no limit.")
    ] = LIVE_KEY_RATE,
    key_burst: Annotated[
        int, _option("--key-burst", "key_burst", "N", "Messages under a key that may come at once, as after an outage.")
    ] = int(_DEFAULTS.key_burst),
    silent_days: Annotated[
        float, _option("--silent-days", "silent_days", "DAYS", "Forget what has been silent for longer.")
    ] = _DEFAULTS.silent_days,
) -> Limits:
    """Return the limits that the options define."""
    return Limits(
        max_payload_bytes,
        max_queue_bytes,
        max_list_samples,
        max_vehicles,
        max_stations,
        max_models,
        max_key_rate,
        key_burst,
        silent_days,
    )


insert_limit_options = insert_options("limits", make_limits, "Limits")
"""Decorator that gives a command the options of the limits in place of its argument `limits`."""

OPTION_OF_CAUSE: Final = {
    "too_many_vehicles": "--max-vehicles",
    "too_many_stations": "--max-stations",
    "too_many_models": "--max-models",
    "too_large": "--max-payload-bytes",
    "too_many_samples": "--max-list-samples",
    "rate_limited": "--max-key-rate",
}
"""Cause of a refusal -> option that sets its limit."""


class LimitLog:
    """Warn once of each limit that has been reached, as a watch of the loop."""

    def __init__(self, pipeline: Pipeline) -> None:
        self._pipeline = pipeline
        self._warned: set[str] = set()

    def __call__(self, _: object) -> None:
        """Warn of limits that were reached since the last call."""
        for cause, option in OPTION_OF_CAUSE.items():
            if cause not in self._warned and (count := self._count(cause)):
                self._warned.add(cause)
                _log.warning(
                    "a limit is reached: what exceeds it is ignored and counted",
                    extra=event_fields(cause=cause, count=count, option=option),
                )

    def _count(self, cause: str) -> int:
        """Return how often a cause has been counted."""
        return self._pipeline.decoder.rejected[cause] + self._pipeline.cars.unpredictable[cause]
