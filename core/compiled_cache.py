"""Keep the cache of compiled functions valid: numba checks only the file of a function, not the files it imports."""

from hashlib import sha256
from pathlib import Path
from types import ModuleType
from typing import Any


def watch_sources(function: Any, *modules: ModuleType) -> None:
    """Let a cached compiled function be recompiled when the source of a module that it uses changes.

    The functions of these modules that it calls must be compiled with `cache=False`. Otherwise numba would link their
    cached versions, which are checked against one file each.
    """
    files = [function.py_func.__code__.co_filename, *(str(module.__file__) for module in modules)]
    digest = sha256(b"".join(Path(file).read_bytes() for file in files)).hexdigest()
    function._cache._cache_file._source_stamp = digest  # noqa: SLF001 - numba has no public way
