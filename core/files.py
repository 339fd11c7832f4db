"""Write files whole, and name what reading damaged content raises.

A file has its old content or its new content, however the process or the disk fails.
"""

import errno
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Final

import msgspec

UNREADABLE: Final = (msgspec.MsgspecError, UnicodeDecodeError, RecursionError)
"""What `msgspec` raises for content that is damaged, of another form or nested too deeply."""
UNREADABLE_TOML: Final = (ValueError, RecursionError)
"""What `tomllib` raises: `TOMLDecodeError`, and another `ValueError` where a number has thousands of digits."""
_LONGEST: Final = 50  # characters of a name, so that the name of the new file is no longer than a folder allows


def write_whole(path: Path, content: bytes) -> None:
    """Write a file; return once it is on disk."""
    with replacing(path) as fresh:
        fresh.write_bytes(content)


@contextmanager
def replacing(path: Path, *, is_kept: bool = True) -> Iterator[Path]:
    """Yield the name of a new file in the same folder, which takes the place of a file once it is complete.

    If anything is raised, the new file is removed, and an existing one is as it was. A link stays a link. A pipe or a
    device, such as `/dev/stdout`, is itself yielded.
    """
    if path.exists() and not path.is_file():
        yield path
        return
    place = Path(os.path.realpath(path))
    is_there = place.exists()
    if is_there and not os.access(place, os.W_OK):  # a rename would replace it all the same
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(path))
    fresh = place.with_name(f".{place.name[:_LONGEST]}.{os.getpid()}.new")
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


def sync(path: Path) -> None:
    """Wait until the content of a file, or the names of the files in a folder, are on disk."""
    number = os.open(path, os.O_RDONLY)
    try:
        os.fsync(number)
    finally:
        os.close(number)
