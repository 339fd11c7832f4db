"""Write files whole, and name and refuse what cannot be read.

A file has its old content or its new content, however the process or the disk fails.
"""

import errno
import glob
import os
import re
import shutil
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Final

import msgspec

from socast.core.errors import ModelError

UNREADABLE: Final = (msgspec.MsgspecError, UnicodeDecodeError, RecursionError)
"""What `msgspec` raises for content that is damaged, of another form or nested too deeply."""
UNREADABLE_TOML: Final = (ValueError, RecursionError)
"""What `parse_toml` raises: `TOMLDecodeError`, and another `ValueError` for endless keys and numbers."""
MOST_KEY_PARTS: Final = 100
"""Largest number of parts of a dotted key; the memory of `tomllib` grows with its square."""
_LONG_KEY: Final = re.compile(rf"(?<![\w\"'-])(?:[\w\"'-]++[ \t]*+\.[ \t]*+){{{MOST_KEY_PARTS}}}")
_LONGEST: Final = 50  # characters of a name, so that the name of the new file is no longer than a folder allows


def write_whole(path: Path, content: bytes) -> None:
    """Write a file; return once it is on disk."""
    with replacing(path) as fresh:
        fresh.write_bytes(content)


@contextmanager
def replacing(path: Path, *, is_kept: bool = True) -> Iterator[Path]:
    """Yield the name of a new file in the same folder, which takes the place of a file once it is complete.

    If anything is raised, the new file is removed, and an existing one is as it was. What a killed process left is
    removed by the next one that writes the file. A link stays a link. A pipe or a device, such as `/dev/stdout`, is
    itself yielded.
    """
    if path.exists() and not path.is_file():
        yield path
        return
    place = Path(os.path.realpath(path))
    is_there = place.exists()
    if is_there and not os.access(place, os.W_OK):  # a rename would replace it all the same
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(path))
    begin = f".{place.name[:_LONGEST]}."
    fresh = place.with_name(f"{begin}{os.getpid()}.new")
    _remove_leftovers(place.parent, begin)
    try:
        yield fresh
        if is_there:
            shutil.copymode(place, fresh)
        if is_kept:
            sync(fresh)
        fresh.replace(place)
    except BaseException:
        with suppress(OSError):
            fresh.unlink()
        raise
    if is_kept:
        sync(place.parent)


def _remove_leftovers(folder: Path, begin: str) -> None:
    """Remove the new files of processes that were killed."""
    for left in folder.glob(f"{glob.escape(begin)}*.new"):
        process = left.name[len(begin) : -len(".new")]
        if process.isdecimal() and not Path("/proc", process).exists() and Path("/proc/self").exists():
            with suppress(OSError):
                left.unlink()


def parse_toml(text: str) -> dict[str, Any]:
    """Return the tables of a text of TOML that a person wrote."""
    if _LONG_KEY.search(text):
        raise ValueError(f"a key has more than {MOST_KEY_PARTS} parts between dots")
    return tomllib.loads(text)


def refuse_beyond_memory(path: Path, rows: int, columns: int) -> None:
    """Refuse to read a table whole whose numbers take more than the memory of this machine, by what its file says."""
    wanted, there = 8 * rows * columns, os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    if wanted > there:
        raise ModelError(
            f"{path} says that it holds {rows:,} rows of {columns:,} columns, about {wanted / 1e9:,.0f} GB, above the "
            f"{there / 1e9:,.0f} GB of memory of this machine: give fewer rows"
        )


def sync(path: Path) -> None:
    """Wait until the content of a file, or the names of the files in a folder, are on disk."""
    number = os.open(path, os.O_RDONLY)
    try:
        os.fsync(number)
    finally:
        os.close(number)
