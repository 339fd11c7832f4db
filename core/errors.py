"""Define the errors whose messages are written for people.

Bad telemetry is counted and never raises an error. A bad command, file, model or effect raises one. Each message names
the value, the limit and the remedy.
"""

import errno
import os
import select
import stat
from collections.abc import Iterable
from difflib import get_close_matches
from itertools import islice
from pathlib import Path
from typing import Final

LARGEST_INPUT: Final = 256 << 20
"""Largest file of settings, effects, a model, findings or a plan that is read. [B]"""
LONGEST_WAIT_S: Final = 60.0
"""Longest wait for the first byte of a pipe that is given in place of such a file. [s]"""


class SocastError(Exception):
    """Serve as the base of every error that the command line prints as one line."""


class RecordingError(SocastError):
    """Report a recording that cannot be opened, or whose content contradicts its header."""


class CatalogueError(SocastError):
    """Report an unknown vehicle model, or a catalogue entry that is incomplete or out of bounds."""


class EffectError(SocastError):
    """Report an effect with a wrong unit, shape, name or declaration."""


class ModelError(SocastError):
    """Report a model that is unknown, or that cannot serve the given data."""


class ImportFileError(SocastError):
    """Report a published data file that is not the one that its importer reads."""


class SettingsError(SocastError):
    """Report a setting that is outside its limits, or with which no connection can be made."""


class AskError(SocastError):
    """Report an outlook query that cannot be answered.

    Parameters
    ----------
    words : str
        Message with value, limit and remedy.
    cause : str
        Cause under which the query is counted, such as `unknown_vehicle` or `too_many_legs`.
    """

    def __init__(self, words: str, cause: str = "question") -> None:
        super().__init__(words)
        self.cause = cause


MOST_LISTED: Final = 40
"""Largest number of known names that an error message lists."""


def suggest_names(name: str, known: Iterable[str]) -> str:
    """Return the remedy for an unknown name: the names that resemble it, or all known ones.

    Examples
    --------
    >>> suggest_names("rod_load", ["road_load", "hybrid"]), suggest_names("horse", ["road_load", "hybrid"])
    ('did you mean road_load?', 'known are road_load, hybrid')
    """
    names = list(known)
    close = get_close_matches(name, names, n=3)
    more = f" and {len(names) - MOST_LISTED:,} more" if len(names) > MOST_LISTED else ""
    return f"did you mean {' or '.join(close)}?" if close else f"known are {', '.join(names[:MOST_LISTED])}{more}"


def read_input(path: Path, limit: int = LARGEST_INPUT) -> bytes:
    """Return the content of a file, if it is not too large to be what it is taken for.

    Units: limit [B].
    """
    with open(path, "rb", opener=_open_soon) as file:
        size = os.fstat(file.fileno()).st_size  # zero for a pipe
        limit = min(limit, max(size, LARGEST_INPUT))
        step = size + 1 if size else 1 << 20  # for what is read, memory is taken at once
        pieces = islice(iter(lambda: file.read(step), b""), limit // step + 1 if size <= limit else 0)
        content = b"".join(pieces)
    if (size := max(size, len(content))) > limit:
        raise OSError(errno.EFBIG, f"it has {size:,} bytes or more, above the limit of {limit:,}", str(path))
    return content


def _open_soon(path: str, flags: int) -> int:
    """Open a file; of a pipe, wait for its first byte at most for `LONGEST_WAIT_S`."""
    number = os.open(path, flags | os.O_NONBLOCK | os.O_CLOEXEC)
    os.set_blocking(number, True)
    if stat.S_ISFIFO(os.fstat(number).st_mode) and not select.select([number], [], [], LONGEST_WAIT_S)[0]:
        os.close(number)
        raise OSError(errno.ETIMEDOUT, f"nothing came from this pipe for {LONGEST_WAIT_S:g} s", path)
    return number
