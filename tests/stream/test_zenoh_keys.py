"""Tests of the keys of received samples."""

from threading import get_ident
from weakref import WeakSet

import pytest
import zenoh

from socast.stream import zenoh_keys
from socast.stream.zenoh_keys import KeyDeclarer, SampleKeys


class DeclaredKey(str):
    """Stand for a declared key, which ends with its last reference."""

    __slots__ = ("__weakref__",)


class FakeSession:
    """Note what is declared, and by which thread."""

    def __init__(self, ends_at: str = "") -> None:
        self.declared: list[str] = []
        self.held: WeakSet[DeclaredKey] = WeakSet()
        self.threads: set[int] = set()
        self._ends_at = ends_at

    def declare_keyexpr(self, key: str) -> DeclaredKey:
        """Declare a key; fail as a closed session does at one of them."""
        if key == self._ends_at:
            raise zenoh.ZError("session closed")
        self.threads.add(get_ident())
        self.declared.append(key)
        self.held.add(out := DeclaredKey(key))
        return out


def test_each_key_is_declared_once_and_by_another_thread():
    session = FakeSession()
    declarer = KeyDeclarer(session)
    keys = SampleKeys(declarer.add)
    numbers = [keys[key] for key in ("fleet/a/telemetry", "fleet/b/telemetry", "fleet/a/telemetry", "fleet/a/forecast")]
    declarer.close()
    assert numbers == [0, 1, 0, -1]
    assert session.declared == ["fleet/a/telemetry", "fleet/b/telemetry", "fleet/a/forecast"]
    assert set(session.held) == set(session.declared), "zenoh undeclares a key that nobody holds"
    assert get_ident() not in session.threads


def test_strangers_who_make_up_keys_are_declared_only_so_many(monkeypatch):
    monkeypatch.setattr(zenoh_keys, "MOST_DECLARED", 3)
    monkeypatch.setattr(zenoh_keys, "_MOST_KEYS", 2)
    session = FakeSession()
    declarer = KeyDeclarer(session)
    keys = SampleKeys(declarer.add)
    for number in range(10):
        keys.begin_list_if_full()
        _ = keys[f"fleet/{number}/telemetry"]
    declarer.close()
    assert session.declared == [f"fleet/{number}/telemetry" for number in range(3)]


def test_keys_of_rare_samples_take_no_place_of_frequent_ones():
    session = FakeSession()
    declarer = KeyDeclarer(session)
    for kind in ("vehicle", "telemetry", "ride", "plan", "batch"):
        declarer.add(f"fleet/a/{kind}")
    declarer.close()
    assert session.declared == ["fleet/a/telemetry", "fleet/a/batch"]


@pytest.mark.parametrize("size", [512, 513])
def test_a_key_that_is_not_remembered_is_not_declared(size):
    session = FakeSession()
    declarer = KeyDeclarer(session)
    keys = SampleKeys(declarer.add)
    _ = keys["/telemetry".rjust(size, "k")]
    declarer.close()
    assert len(session.declared) == (size == 512)


def test_declarer_outlives_the_session():
    session = FakeSession(ends_at="fleet/b/telemetry")
    declarer = KeyDeclarer(session)
    for name in "abc":
        declarer.add(f"fleet/{name}/telemetry")
    declarer.close()
    declarer.close()
    assert session.declared == ["fleet/a/telemetry"]
