"""A compiled function is compiled anew when a source that it depends on changes, and kept where one may write."""

import importlib
import json
import pkgutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from numba import njit
from numba.core.caching import NullCache
from numba.core.registry import CPUDispatcher

import socast.core
from socast.core.compiled_cache import watch_sources

READ_ONLY = "import os; os.access = lambda *_: False\n"
RUN = """
import json
from socast.core.wire.message_block import Message, MessageBlock, copy_spans
MessageBlock.of([Message("k", b"{}", 0)]).compact()
print(json.dumps([os.environ["NUMBA_CACHE_DIR"], list(copy_spans.stats.cache_hits.values())]))
"""
NOWHERE = """
import sys, tempfile
def refuse(**_):
    raise OSError(30, "Read-only file system")
tempfile.mkdtemp = refuse
sys.argv = ["socast", "tables", "--help"]
from socast.__main__ import main
main()
"""


def list_cached_functions():
    names = [module.name for module in pkgutil.walk_packages(socast.core.__path__, "socast.core.")]
    values = [value for name in names for value in vars(importlib.import_module(name)).values()]
    functions = {id(value): value for value in values if isinstance(value, CPUDispatcher)}
    return [function for function in functions.values() if not isinstance(function._cache, NullCache)]


def list_called_functions(function):
    code, names = function.py_func.__code__, function.py_func.__globals__
    return [names[name] for name in code.co_names if isinstance(names.get(name), CPUDispatcher)]


@pytest.mark.parametrize("function", list_cached_functions(), ids=lambda each: each.py_func.__qualname__)
def test_cached_function_that_calls_into_another_file_watches_its_source(function):
    file = function.py_func.__code__.co_filename
    pending, others = list_called_functions(function), []
    while pending:
        called = pending.pop()
        others += [called] if called.py_func.__code__.co_filename != file else []
        pending += list_called_functions(called)
    if others:
        assert isinstance(function._cache._cache_file._source_stamp, str)  # a digest; numba's own stamp is a tuple
    assert all(isinstance(called._cache, NullCache) for called in others)


def test_stamp_changes_with_source_of_watched_module(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(tmp_path))
    source = tmp_path / "watched_constants.py"
    source.write_text("FACTOR = 2.0\n")
    constants = importlib.import_module("watched_constants")
    doubled = njit(cache=True)(_scale)
    stamps = []
    for text in ("FACTOR = 2.0\n", "FACTOR = 3.0\n", "FACTOR = 2.0\n"):
        source.write_text(text)
        watch_sources(doubled, constants)
        stamps.append(doubled._cache._cache_file._source_stamp)
    assert stamps[0] == stamps[2] != stamps[1]


def _scale(values: np.ndarray) -> np.ndarray:
    return 2.0 * values


def run_python(code):
    return subprocess.run([sys.executable, "-c", READ_ONLY + code], capture_output=True, text=True, check=False)


def test_compiled_code_is_copied_to_a_temporary_folder_where_no_other_can_be_written():
    folder, hits = json.loads(run_python(RUN).stdout)
    assert hits == [1]
    assert not Path(folder).exists(), "it is removed at the end"


def test_missing_temporary_folder_is_one_line():
    done = run_python(NOWHERE)
    assert done.returncode == 1
    reason = "no folder for compiled code can be written: Read-only file system"
    assert done.stderr == f"socast: {reason}; set NUMBA_CACHE_DIR or TMPDIR to one that can\n"
