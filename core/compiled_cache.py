"""Keep the cache of compiled functions valid, and find a place for it where the sources are read-only.

All modules take `njit` from here, because numba looks for a place when a function is declared.
"""

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import suppress
from hashlib import sha256
from pathlib import Path
from stat import S_ISDIR
from types import ModuleType
from typing import Any, Final

from numba import njit
from numba.core import config
from numba.core.caching import UserProvidedCacheLocator

__all__ = "njit", "watch_sources"

VARIABLE: Final = "NUMBA_CACHE_DIR"
"""Environment variable with the folder in which numba keeps compiled functions."""
_PACKAGE: Final = Path(__file__).parents[1]


def watch_sources(function: Any, *modules: ModuleType) -> None:
    """Let a cached compiled function be recompiled when the source of a module that it uses changes.

    The functions of these modules that it calls must be compiled with `cache=False`. Otherwise numba would link their
    cached versions, which are checked against one file each.
    """
    files = [function.py_func.__code__.co_filename, *(str(module.__file__) for module in modules)]
    digest = sha256(b"".join(Path(file).read_bytes() for file in files)).hexdigest()
    function._cache._cache_file._source_stamp = digest  # noqa: SLF001 - numba has no public way


def _place_cache() -> None:
    """Let numba keep compiled functions in a temporary folder of the user where it can keep them nowhere else.

    numba writes to the folder that `VARIABLE` names, beside the sources, or to the cache of the user, and refuses to
    compile where it may write to none of them, as in a container with a read-only file system. A new folder begins with
    what was compiled beside the sources, as far as it has room. Later processes use the same folder.
    """
    if any(map(_may_write, _list_places())):
        return
    with suppress(OSError):  # without a folder, numba refuses to compile
        folder, is_new = _make_folder()
        os.environ[VARIABLE] = folder
        config.CACHE_DIR = folder  # type: ignore[attr-defined]
        if is_new:
            _copy_compiled(folder)


def _list_places() -> Iterator[str]:
    """Yield the folders in which numba would keep compiled functions."""
    if folder := os.environ.get(VARIABLE):
        yield folder
    yield str(_PACKAGE / "core" / "__pycache__")
    cache = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")  # noqa: PTH111 - never raises
    yield os.path.join(cache, "numba")  # noqa: PTH118


def _may_write(folder: str) -> bool:
    """Return whether this process may write to a folder, or make it."""
    folder = os.path.abspath(folder)  # noqa: PTH100
    while folder != os.path.dirname(folder) and not os.path.exists(folder):  # noqa: PTH110, PTH120 - `Path` would raise
        folder = os.path.dirname(folder)  # noqa: PTH120
    return os.path.isdir(folder) and os.access(folder, os.W_OK | os.X_OK)  # noqa: PTH112


def _make_folder() -> tuple[str, bool]:
    """Return a folder that only this user may read and write, and whether it is new."""
    folder = os.path.join(tempfile.gettempdir(), f"socast-compiled-{os.getuid()}")  # noqa: PTH118
    try:
        os.mkdir(folder, 0o700)  # noqa: PTH102
    except FileExistsError:
        found = os.lstat(folder)
        if S_ISDIR(found.st_mode) and found.st_uid == os.getuid() and not found.st_mode & 0o077:
            return folder, False
        return tempfile.mkdtemp(prefix="socast-compiled-"), True
    return folder, True


def _copy_compiled(folder: str) -> None:
    """Copy what was compiled beside the sources; numba divides its folder by those of the sources."""
    find_part: Any = UserProvidedCacheLocator.get_suitable_cache_subpath
    for package in ("core", "stream"):
        for compiled in (_PACKAGE / package).rglob("__pycache__/*.nb?"):
            any_source = compiled.parents[1] / "any.py"
            part = Path(folder, find_part(str(any_source)))
            part.mkdir(exist_ok=True)
            unfinished = part / f"{compiled.name}.part"
            try:
                shutil.copyfile(compiled, unfinished)
                unfinished.replace(part / compiled.name)
            except OSError:
                unfinished.unlink(missing_ok=True)
                raise


_place_cache()
