"""Fixtures of the tests of effects."""

import pytest

from core.effects import registry


@pytest.fixture
def _checks_here(monkeypatch):
    """Check files of effects in this process, which saves that of a process for each; both run the same check."""
    monkeypatch.setattr(registry, "_check_apart", lambda path, _: registry._check_here(path))
