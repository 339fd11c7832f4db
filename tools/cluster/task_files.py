"""Folders and files by which tasks pass on what they have made."""

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield the name of a file that takes its place once it is complete, so that a killed task leaves nothing.

    Two workers may run a task at once, after a connection was lost; both write the same bytes.
    """
    own = path.with_name(f"{path.name}.{os.getpid()}")
    yield own
    own.replace(path)


@contextmanager
def make_scratch(folder: Path) -> Iterator[Path]:
    """Yield a new folder in another one for intermediate files, which only this user can read."""
    scratch = Path(tempfile.mkdtemp(prefix=".scratch-", dir=folder)).resolve()
    try:
        yield scratch
    finally:
        shutil.rmtree(scratch, ignore_errors=True)
