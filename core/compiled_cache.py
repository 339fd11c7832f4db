"""Keep the cache of compiled functions valid, and find a place for it where the sources are read-only."""

import os
from pathlib import Path
from types import ModuleType
from typing import Any, Final

_PACKAGE: Final = Path(__file__).parents[1]
_COMPILED: Final = "core", "stream"
"""Packages with compiled functions."""
_PLACE: Final = "NUMBA_CACHE_DIR"


def watch_sources(function: Any, *modules: ModuleType) -> None:
    """Let a cached compiled function be recompiled when the source of a module that it uses changes.

    The functions of these modules that it calls must be compiled with `cache=False`. Otherwise numba would link their
    cached versions, which are checked against one file each.
    """
    from hashlib import sha256  # noqa: PLC0415 - see below

    files = [function.py_func.__code__.co_filename, *(str(module.__file__) for module in modules)]
    digest = sha256(b"".join(Path(file).read_bytes() for file in files)).hexdigest()
    function._cache._cache_file._source_stamp = digest  # noqa: SLF001 - numba has no public way


def place_cache() -> None:
    """Let numba keep compiled functions in a temporary folder where it could not keep them elsewhere.

    numba writes beside the sources or to the cache of the user, and refuses to compile where it may write to neither,
    as in a container with a read-only file system. What was compiled beside the sources is copied, so that it needs not
    be compiled again. Sub-processes use the same folder, and it is removed at the end of this process.

    Raises
    ------
    SystemExit
        If there is no temporary folder either: nothing that predicts can run.
    """
    user = Path(os.environ.get("XDG_CACHE_HOME") or Path("~/.cache").expanduser()) / "numba"
    asked = [Path(folder)] if (folder := os.environ.get(_PLACE)) else []
    if any(map(_may_write, [*asked, _PACKAGE / "core" / "__pycache__", user])):
        return
    import atexit  # noqa: PLC0415 - every start comes here, and most go no further
    import shutil  # noqa: PLC0415
    import tempfile  # noqa: PLC0415

    try:
        folder = tempfile.mkdtemp(prefix="socast-")
    except OSError as error:
        reason = f"no folder for compiled code can be written: {error.strerror}"
        raise SystemExit(f"socast: {reason}; set {_PLACE} or TMPDIR to one that can") from error
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    os.environ[_PLACE] = folder
    from numba.core import caching, config  # noqa: PLC0415

    find_place: Any = caching.UserProvidedCacheLocator.get_suitable_cache_subpath

    config.CACHE_DIR = folder  # type: ignore[attr-defined]
    for compiled in [each for name in _COMPILED for each in (_PACKAGE / name).rglob("__pycache__/*.nb?")]:
        source = compiled.parents[1] / "any.py"
        place = Path(folder, find_place(str(source)))
        place.mkdir(exist_ok=True)
        shutil.copyfile(compiled, place / compiled.name)


def _may_write(folder: Path) -> bool:
    """Return whether this process may write to a folder, or make it."""
    while not folder.exists():
        folder = folder.parent
    return os.access(folder, os.W_OK | os.X_OK)
