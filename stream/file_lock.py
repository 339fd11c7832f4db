"""Locks that keep a second process from writing the same files."""

import fcntl
import os
from contextlib import suppress
from pathlib import Path

from socast.core.errors import SettingsError
from socast.stream.closeable import Closeable


class FileLock(Closeable):
    """Hold a lock for the life of the process.

    The operating system frees the lock when the process ends, however it ends. The lock file remains.

    Parameters
    ----------
    lock : Path
        Lock file; it is made if it does not exist.
    what : str
        File or folder that the lock protects, for the message, such as `--state fleet.state`.
    """

    def __init__(self, lock: Path, what: str) -> None:
        try:
            self._file = os.open(lock, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        except OSError as error:
            raise SettingsError(f"{what} cannot be written: {error.strerror}; choose another place") from error
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            owner = os.read(self._file, 20).decode(errors="replace").strip()
            os.close(self._file)
            who = f"process {owner}" if owner else "another process"
            raise SettingsError(f"{what} is in use by {who}; stop that process, or choose another place") from error
        with suppress(OSError):  # the name is for the message of others; a full disk may refuse it
            os.ftruncate(self._file, 0)
            os.pwrite(self._file, f"{os.getpid()}\n".encode(), 0)

    def close(self) -> None:
        """Free the lock; a second call has no effect."""
        number, self._file = self._file, -1
        if number >= 0:
            os.close(number)
