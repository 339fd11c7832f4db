"""A compiled function is compiled anew when a source that it depends on changes, and kept where one may write."""

import importlib
import json
import os
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
from socast.core.compiled_cache import _may_write, watch_sources

READ_ONLY = """
import os, sys, tempfile
os.access = lambda *_: False
tempfile.tempdir = sys.argv.pop(1)
"""
RUN = """
import json
from socast.core.wire.message_block import Message, MessageBlock, copy_spans
MessageBlock.of([Message("k", b"{}", 0)]).compact()
print(json.dumps([os.environ["NUMBA_CACHE_DIR"], list(copy_spans.stats.cache_hits.values())]))
"""
NOWHERE = """
import tempfile
def refuse(*_, **__):
    raise OSError(30, "Read-only file system")
os.mkdir = tempfile.TemporaryFile = refuse
sys.argv = ["socast", "tables", "x"]
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


def run_python(code, temporary):
    command = [sys.executable, "-c", READ_ONLY + code, str(temporary)]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def test_compiled_code_is_copied_to_one_folder_of_the_user_where_no_other_can_be_written(tmp_path):
    for _ in range(2):
        folder, hits = json.loads(run_python(RUN, tmp_path).stdout)
        assert hits == [1]
        assert [Path(folder)] == list(tmp_path.iterdir())
        assert Path(folder).stat().st_mode & 0o077 == 0
        assert not list(Path(folder).rglob("*.part"))


@pytest.mark.parametrize("kind", ["open to others", "a link"])
def test_folder_that_another_may_have_made_is_not_used(tmp_path, kind):
    name = tmp_path / f"socast-compiled-{os.getuid()}"
    if kind == "a link":
        (tmp_path / "elsewhere").mkdir()
        name.symlink_to(tmp_path / "elsewhere")
    else:
        name.mkdir()
        name.chmod(0o777)
    folder, hits = json.loads(run_python(RUN, tmp_path).stdout)
    assert hits == [1]
    assert Path(folder) != name
    assert not list(name.iterdir())


def test_missing_temporary_folder_is_one_line(tmp_path):
    done = run_python(NOWHERE, tmp_path)
    reason = "no folder for compiled code can be written"
    assert done.stderr == f"socast: {reason}: set NUMBA_CACHE_DIR or TMPDIR to one that can\n"
    assert done.returncode == 2


def test_places_that_cannot_be_searched_or_do_not_exist_are_not_written(tmp_path, monkeypatch):
    assert _may_write(str(tmp_path / "a" / "b"))
    (tmp_path / "file").touch()
    assert not _may_write(str(tmp_path / "file" / "b"))
    monkeypatch.chdir(tmp_path)
    assert _may_write("here")


@pytest.mark.skipif(os.getuid() != 0, reason="only root may become another user")
def test_other_user_without_home_writes_nowhere(tmp_path):
    (tmp_path / "closed").mkdir(mode=0o700)
    code = f"""
import os
from socast.core.compiled_cache import _list_places, _may_write
del os.environ["HOME"]
os.setgid(12345)
os.setuid(12345)
print(len(list(_list_places())), _may_write({str(tmp_path / "closed" / "b")!r}))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.stdout.split()[1:] == ["False"], done.stderr
