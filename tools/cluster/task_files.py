"""Folders and files by which tasks pass on what they have made."""

import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def make_scratch(folder: Path) -> Iterator[Path]:
    """Yield a new folder in another one for intermediate files, which only this user can read."""
    scratch = Path(tempfile.mkdtemp(prefix=".scratch-", dir=folder)).resolve()
    try:
        yield scratch
    finally:
        shutil.rmtree(scratch, ignore_errors=True)
