"""Settings and fixtures of every test."""

import gc
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from subprocess import Popen
from typing import Any

import numpy as np
import pytest
from hypothesis import settings

from tests.support.browsers import REMEDY
from tests.support.kernels import start_compiler, wait_for_compiler

settings.register_profile("quick", max_examples=15, deadline=None, derandomize=True)
settings.load_profile("quick")


sys.dont_write_bytecode = False  # with the tests that pytest has rewritten in a cache, a worker starts 15 s earlier
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
os.environ.pop("COLUMNS", None)  # parallel workers have it, and the pages show the width of a pipe

MORE_WORKERS = 1
"""Number of parallel workers beyond one for each processor."""
OF_WORKERS = {
    "OPENBLAS_NUM_THREADS": "1",  # the workers have all processors; more threads would wait for each other
    "OMP_NUM_THREADS": "1",
    "MALLOC_MMAP_THRESHOLD_": str(2**25),  # to give each large array back, and get it anew, takes a third of a fit
    "MALLOC_TRIM_THRESHOLD_": str(2**28),
}
"""Environment of the parallel workers and of all processes that they start."""
COMPILER = pytest.StashKey[Popen[str]]()
"""Process that compiles the kernels while the parallel workers collect tests."""


def pytest_configure(config: pytest.Config) -> None:
    """Compile the kernels once, before parallel workers would each compile them, and let these keep the order."""
    config.addinivalue_line("markers", "long: the file takes 8 s or more; parallel workers start with such files")
    if getattr(config.option, "numprocesses", None) and not config.option.collectonly:
        for name, value in OF_WORKERS.items():
            os.environ.setdefault(name, value)
        config.stash[COMPILER] = start_compiler()
        config.option.loadscopereorder = False


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers() -> int | None:
    """Start more workers than processors, because a worker often waits for processes, sessions and pages."""
    return None if "PYTEST_XDIST_AUTO_NUM_WORKERS" in os.environ else (os.cpu_count() or 1) + MORE_WORKERS


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_node_collection_finished(node: Any) -> None:
    """Let workers begin only with compiled kernels."""
    if compiler := node.config.stash.get(COMPILER, None):
        wait_for_compiler(compiler)
        del node.config.stash[COMPILER]


@pytest.hookimpl(tryfirst=True)
def pytest_collection() -> None:
    """Keep the tests, as they are collected, from the search for garbage, which would find them alive each time."""
    gc.disable()


def pytest_collection_finish() -> None:
    """Search only what tests make for garbage, and more rarely; that saves a twentieth of their processor time."""
    gc.freeze()
    gc.set_threshold(10_000, 20, 20)
    gc.enable()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put long files first, so that no worker begins one when the other has nothing left to do."""
    items.sort(key=lambda item: item.get_closest_marker("long") is None)


def pytest_terminal_summary(terminalreporter: Any) -> None:
    """Say in one line that pages were not opened, and how to change that."""
    if any(REMEDY in str(report.longrepr) for report in terminalreporter.stats.get("skipped", ())):
        terminalreporter.write_line(REMEDY)


@pytest.fixture(scope="session", autouse=True)
def _write_to_the_cache_of_the_system() -> Iterator[None]:
    """Do not wait until files are on the disk: what tests read is in the cache of the operating system."""

    def check(file: Any) -> None:
        os.fstat(file if isinstance(file, int) else file.fileno())

    with pytest.MonkeyPatch.context() as patch:
        for name in ("fsync", "fdatasync"):
            patch.setattr(os, name, check)
        yield


@pytest.fixture(autouse=True)
def _restore_libraries() -> Iterator[None]:
    """Remove the effects and vehicle models that a test has loaded, so that no later test depends on the order."""
    from tests.support.libraries import restored_libraries  # noqa: PLC0415 - tests that start processes need no core

    with restored_libraries():
        yield


@pytest.fixture
def _checks_here(monkeypatch: pytest.MonkeyPatch) -> None:
    """Check files of effects in this process, which saves that of a process for each; both run the same check."""
    from socast.core.effects import registry  # noqa: PLC0415 - tests that start processes need no core

    monkeypatch.setattr(registry, "_check_apart", lambda path, _: registry._check_here(path))


@pytest.fixture
def rng() -> np.random.Generator:
    """Return a generator of random numbers that is the same for every test."""
    return np.random.default_rng(7)


@pytest.fixture(scope="session")
def shift_tables(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder that `socast tables recordings/shift.mcap` writes; tests do not change it."""
    return _tables(tmp_path_factory, "shift")


@pytest.fixture(scope="session")
def autumn_tables(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder that `socast tables recordings/autumn.mcap` writes; tests do not change it."""
    return _tables(tmp_path_factory, "autumn")


def _tables(factory: pytest.TempPathFactory, name: str) -> Path:
    """Return the tables of a recording that the repository holds."""
    from tests.support.commands import done  # noqa: PLC0415 - commands take seconds to import
    from tests.support.paths import RECORDINGS  # noqa: PLC0415
    from tests.support.shared_files import make_once  # noqa: PLC0415

    return make_once(factory, name, lambda folder: done("tables", RECORDINGS / f"{name}.mcap", "--out", folder))
