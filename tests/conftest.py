"""Settings and fixtures of every test."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from hypothesis import settings

settings.register_profile("quick", max_examples=15, deadline=None, derandomize=True)
settings.load_profile("quick")


def pytest_configure(config: pytest.Config) -> None:
    """Compile the kernels once, before parallel workers would each compile them."""
    if getattr(config.option, "numprocesses", None) and not config.option.collectonly:
        from tests.support.kernels import compile_kernels  # noqa: PLC0415 - workers must not import it

        compile_kernels()


@pytest.fixture(autouse=True)
def _restore_effects() -> Iterator[None]:
    """Remove the effects that a test has loaded from files, so that no later test depends on the order."""
    from core.effects import registry  # noqa: PLC0415 - tests that start processes need no core

    effects, files = dict(registry._library), dict(registry._brought_by)
    yield
    for kept, now in ((effects, registry._library), (files, registry._brought_by)):
        if now != kept:
            now.clear()
            now.update(kept)


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
