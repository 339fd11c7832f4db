"""The file that keeps the state of every car: replaced whole, with the state before it as a second copy."""

import logging
import os
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

from socast.core.errors import SettingsError, SocastError, read_input
from socast.core.files import replacing, sync
from socast.stream.closeable import Closeable
from socast.stream.file_lock import FileLock
from socast.stream.structured_log import event_fields

PREVIOUS: Final = ".previous"
"""End of the name of the file that holds the state before the last one."""
DAMAGED: Final = ".damaged"
"""End of the name under which the next save keeps a last state that could not be used."""

LARGEST_STATE: Final = 4 << 30
"""Largest state that is read. [B]"""

_log = logging.getLogger("socast.state")


class StateFile(Closeable):
    """Save and load snapshots under one name; a context manager that locks the file for this process.

    A complete state exists under the name at any time, however the process ends. `{name}.previous` holds the state
    that was saved before it. A last state that could not be used never replaces that one: the next save keeps it as
    `{name}.damaged`.

    Attributes
    ----------
    loaded : Path or None
        File that `load` used: the last state, or the one before.
    failure : str
        Why `load` could not use the last state; empty if it did.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._previous = path.with_name(path.name + PREVIOUS)
        self.loaded: Path | None = None
        self.failure = ""
        self._is_damaged = False
        self._lock = FileLock(path.with_name(f".{path.name}.lock"), f"--state {path}")

    @property
    def exists(self) -> bool:
        """Return whether a state was saved."""
        return self.path.exists() or self._previous.exists()

    def load(self, restore: Callable[[bytes], Any]) -> Any:
        """Restore the last state that is intact, and return what `restore` returns."""
        failure: SocastError | None = None
        for path in (self.path, self._previous):
            try:
                note = restore(read_input(path, LARGEST_STATE))
            except FileNotFoundError:
                continue
            except OSError as error:
                failure = failure or SettingsError(f"{path} cannot be read: {error.strerror}")
            except SocastError as error:
                failure = failure or SocastError(f"{path}: {error}")
            else:
                self.loaded, self._is_damaged = path, failure is not None
                self.failure = str(failure or "") if path == self.path or failure else f"{self.path} does not exist"
                return note
        if failure is not None and self._previous.exists():
            raise SocastError(f"{failure}; {self._previous} cannot be used either: restore a copy, or move both away")
        raise failure or SettingsError(f"{self.path} does not exist")

    def save(self, snapshot: bytes) -> None:
        """Replace the state; return once it is on disk."""
        try:
            with replacing(self.path) as fresh:
                fresh.write_bytes(snapshot)
                sync(fresh)  # before the last state takes another name
                kept = self._keep_last()
        except OSError as error:
            raise SettingsError(
                f"--state {self.path} cannot be written: {error.strerror}; choose another file"
            ) from error
        if self._is_damaged:
            self._is_damaged = False
            _log.warning("the damaged state is kept for its examination", extra=event_fields(file=str(kept)))

    def close(self) -> None:
        """Free the lock; a second call has no effect."""
        self._lock.close()

    def _keep_last(self) -> Path:
        """Give the last state a second name and return it, so that the first name is never without a file."""
        kept = self.path.with_name(self.path.name + DAMAGED) if self._is_damaged else self._previous
        link = self.path.with_name(f".{self.path.name}.link")
        with suppress(FileNotFoundError):
            link.unlink()
        with suppress(FileNotFoundError):
            os.link(self.path, link)
            link.replace(kept)
        return kept
