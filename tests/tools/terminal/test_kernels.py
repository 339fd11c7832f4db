"""Test that all kernels are compiled at the installation, and that the progress is reported."""

import os
import subprocess
import sys

from numba import njit

from core.models import EXTENDED_PHYSICAL
from tests.support.paths import ROOT
from tools.terminal import kernels
from tools.terminal.kernels import compile_kernels

CODE = """
from tools.terminal.kernels import compile_kernels, list_kernels
reports = []
count = compile_kernels(report=lambda *numbers: reports.append(numbers))
print(count, len(list_kernels()), reports[0][0], reports[-1])
"""


def test_every_kernel_is_compiled_and_reported_from_the_first_to_the_last(tmp_path):
    fresh = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}
    command = [sys.executable, "-c", CODE]
    done = subprocess.run(command, cwd=ROOT, env=fresh, capture_output=True, text=True, check=True)
    count, *others = done.stdout.split(maxsplit=3)
    assert int(count) >= 27
    assert others == [count, "1", f"({count}, {count})\n"]


def test_kernels_in_the_cache_are_not_reported():
    compile_kernels()
    assert compile_kernels(EXTENDED_PHYSICAL, report=lambda *_: 1 / 0) == 0


def test_progress_counts_kernels_but_not_their_parts(monkeypatch):
    part = njit(lambda x: x + 1.0)
    kernel = njit(lambda x: part(x) * 2.0)
    monkeypatch.setattr(kernels, "list_kernels", lambda: {kernel})
    monkeypatch.setattr(kernels, "_run_kernels", lambda *_: kernel(1.0))
    reports: list[tuple[int, int]] = []
    assert compile_kernels(report=lambda *numbers: reports.append(numbers)) == 1
    assert reports == [(1, 1)]


def test_make_compiles_the_kernels_after_the_installation():
    rule = (ROOT / "Makefile").read_text(encoding="utf-8").partition("$(INSTALLED):")[2].partition("demo:")[0]
    assert "-m tools.terminal.kernels\n\ttouch $@" in rule
