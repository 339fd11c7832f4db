"""The options of `socast live` that say where and how it records."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from socast.stream.recorder import FILE_BYTES, FILE_S, FLUSH_S, Recorder
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
