"""Test that all kernels are compiled at the installation, and that the progress is reported."""

import json
import re
import subprocess
import sys
from collections import Counter

import pytest
from numba import njit

from socast.core.models import EXTENDED_PHYSICAL
from socast.tools.terminal import kernels
from socast.tools.terminal.kernels import compile_kernels
from tests.support.paths import ROOT

CODE = """
import json
from collections import Counter
from numba.core.dispatcher import Dispatcher
from socast.tools.terminal.kernels import compile_kernels, list_kernels

def called(kernel):
    names = kernel.py_func.__code__.co_names
    return {each for name in names if isinstance(each := kernel.py_func.__globals__.get(name), Dispatcher)}

compile_kernels()
every = list_kernels()
ready = {each for each in every if each.signatures}
assert ready, "no kernel has run"
while more := {part for each in ready for part in called(each)} - ready:
    ready |= more
print(json.dumps({
    "listed": Counter(each.py_func.__module__ for each in every),
    "not compiled": [each.py_func.__qualname__ for each in every - ready],
}))
"""
"""A kernel is compiled once it has run, or as a part of another one that has run and calls it."""

DEFINITION = re.compile(r"^ *@njit\([^)]*cache=True", re.MULTILINE)


@pytest.fixture(scope="module")
def found():
    """Return the kernels that a process of its own finds: how many in each module, and which it has not compiled."""
    return json.loads(subprocess.run([sys.executable, "-c", CODE], cwd=ROOT, capture_output=True, check=True).stdout)


def test_every_kernel_is_compiled(found):
    assert found["not compiled"] == []


def test_list_of_kernels_holds_all_that_the_sources_define(found):
    defined = Counter()
    for package in ("core", "stream"):
        for file in (ROOT / package).rglob("*.py"):
            module = ".".join(("socast", *file.relative_to(ROOT).with_suffix("").parts))
            defined[module] = len(
                re.findall(r"^ *@njit\([^)]*cache=True", file.read_text(encoding="utf-8"), re.MULTILINE)
            )
    assert found["listed"] == +defined


def test_part_of_another_process_compiles_what_the_whole_needs():
    code = "from socast.tools.terminal.kernels import _run_cleaning; _run_cleaning()"
    again = (
        "from socast.core.cleaning.kernel import clean_rows; from socast.tools.terminal.kernels import _run_kernels;"
        "from socast.core.models import EXTENDED_PHYSICAL; _run_kernels(EXTENDED_PHYSICAL);"
        "print(sum(clean_rows.stats.cache_misses.values()))"
    )
    for each in (code, again):
        done = subprocess.run([sys.executable, "-c", each], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout == "0\n"


def test_kernels_in_the_cache_are_not_reported():
    compile_kernels()
    assert compile_kernels(EXTENDED_PHYSICAL, report=lambda *_: 1 / 0) == 0


def test_progress_counts_kernels_from_the_first_to_the_last_but_not_their_parts(monkeypatch):
    part = njit(lambda x: x + 1.0)
    every = [njit(lambda x: part(x) * 2.0), njit(lambda x: x - 1.0), njit(lambda x: -x)]
    monkeypatch.setattr(kernels, "list_kernels", lambda: set(every))
    monkeypatch.setattr(kernels, "_run_kernels", lambda *_: [each(1.0) for each in every])
    monkeypatch.setattr(kernels, "INTERVAL_S", 3600.0)
    reports: list[tuple[int, int]] = []
    assert compile_kernels(report=lambda *numbers: reports.append(numbers)) == 3
    assert reports == [(1, 3), (3, 3)]


def test_make_compiles_the_kernels_after_the_installation():
    rule = (ROOT / "Makefile").read_text(encoding="utf-8").partition("$(RUNS):")[2].partition("$(INSTALLED):")[0]
    assert "-m socast.tools.terminal.kernels\n\ttouch $@" in rule


def test_help_explains_and_compiles_nothing(monkeypatch, capsys):
    monkeypatch.setattr("socast.tools.terminal.kernels.compile_kernels", lambda: pytest.fail("compiled"))
    with pytest.raises(SystemExit) as ended:
        kernels.main(["--help"])
    assert ended.value.code == 0
    assert "Compile the kernels and keep them in the cache" in capsys.readouterr().out
