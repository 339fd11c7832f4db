"""Files that are expensive to make: each is made once a session and shared between the parallel workers."""

from collections.abc import Callable
from pathlib import Path

import pytest
from filelock import FileLock


def make_once(factory: pytest.TempPathFactory, name: str, make: Callable[[Path], None]) -> Path:
    """Return a path below the session's folder, and make what lies there unless another worker has made it.

    Parameters
    ----------
    factory : TempPathFactory
    name : str
        Of a file or a folder.
    make : callable
        Writes the file, or fills the folder, at the path that it is given.
    """
    base = factory.getbasetemp()
    if "-" in base.name and base.name.startswith("popen"):  # a worker of pytest-xdist has a folder of its own
        base = base.parent
    path, done = base / name, base / f"{name}.done"
    with FileLock(base / f"{name}.lock"):
        if not done.exists():
            make(path)
            done.touch()
    return path
