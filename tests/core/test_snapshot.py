"""Test that a damaged snapshot, or one of another version, is refused."""

import pytest

from socast.core import snapshot
from socast.core.errors import SocastError
from socast.core.snapshot import open_snapshot, seal_snapshot

STATE = {"model": "basic_physical/1", "effects": ["rolling"], "lanes": ["a"]}


def test_sealed_state_opens_unchanged():
    state = open_snapshot(seal_snapshot(STATE))
    assert {name: state[name] for name in STATE} == STATE


def test_snapshot_of_other_version_is_refused_with_both_versions(monkeypatch):
    kept = seal_snapshot(STATE)
    now = snapshot.SNAPSHOT + 1
    monkeypatch.setattr(snapshot, "SNAPSHOT", now)
    refused = (
        rf"^snapshot made by another version of socast: its form is {now - 1}, and this one {now}; start without it$"
    )
    with pytest.raises(SocastError, match=refused):
        open_snapshot(kept)


@pytest.mark.parametrize("at", [0, 31, 32, -1])
def test_single_changed_bit_is_detected(at):
    kept = bytearray(seal_snapshot(STATE))
    kept[at] ^= 1
    with pytest.raises(SocastError, match="damaged"):
        open_snapshot(bytes(kept))
