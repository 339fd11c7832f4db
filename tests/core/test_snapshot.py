"""Snapshots tell whether they are whole, and of which version."""

import pytest

from core import snapshot
from core.errors import SocastError
from core.snapshot import opened, sealed

STATE = {"model": "basic_physical/1", "effects": ["rolling"], "lanes": ["a"]}


def test_what_was_sealed_is_opened():
    found = opened(sealed(STATE), ["rolling"])
    assert {name: found[name] for name in STATE} == STATE


def test_another_version_or_other_effects_are_refused_in_one_line(monkeypatch):
    kept = sealed(STATE)
    refused = r"^snapshot of model basic_physical/1: made by another version or with other effects; start without it$"
    with pytest.raises(SocastError, match=refused):
        opened(kept, ["rolling", "climbing"])
    monkeypatch.setattr(snapshot, "SNAPSHOT", snapshot.SNAPSHOT + 1)
    with pytest.raises(SocastError, match=refused):
        opened(kept, ["rolling"])


@pytest.mark.parametrize("at", [0, 31, 32, -1])
def test_a_bit_that_changed_is_noticed(at):
    kept = bytearray(sealed(STATE))
    kept[at] ^= 1
    with pytest.raises(SocastError, match="damaged"):
        opened(bytes(kept), ["rolling"])
