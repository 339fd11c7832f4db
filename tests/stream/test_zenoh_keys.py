"""Tests of the keys of received samples."""

from threading import Event, get_ident

import pytest
import zenoh

from socast.stream import zenoh_keys
from socast.stream.zenoh_keys import KeyDeclarer, SampleKeys


class FakeSession:
    """Note what is declared, and by which thread."""

    def __init__(self, ends_at: str = "") -> None:
        self.declared: list[str] = []
        self.threads: set[int] = set()
        self.undeclared = Event()
        self._ends_at = ends_at

    def declare_keyexpr(self, key: str) -> str:
        """Declare a key; fail as a closed session does at one of them."""
        if key == self._ends_at:
            raise zenoh.ZError("session closed")
        self.threads.add(get_ident())
        self.declared.append(key)
        return key

    def undeclare(self, key: str) -> None:
        """Undeclare a key."""
        self.declared.remove(key)
        if not self.declared:
            self.undeclared.set()


def test_each_key_is_declared_once_and_by_another_thread():
    session = FakeSession()
    declarer = KeyDeclarer(session)
    keys = SampleKeys(declarer.add)
    numbers = [keys[key] for key in ("fleet/a/telemetry", "fleet/b/telemetry", "fleet/a/telemetry", "fleet/a/forecast")]
    declarer.close()
    assert numbers == [0, 1, 0, -1]
    assert session.declared == ["fleet/a/telemetry", "fleet/b/telemetry", "fleet/a/forecast"]
    assert get_ident() not in session.threads


def test_keys_are_undeclared_where_strangers_make_up_too_many(monkeypatch):
    monkeypatch.setattr(zenoh_keys, "_MOST_KEYS", 3)
    session = FakeSession()
    declarer = KeyDeclarer(session)
    keys = SampleKeys(declarer.add)
    for number in range(3):
        _ = keys[f"fleet/{number}/telemetry"]
    assert keys.begin_list_if_full()
    declarer.forget()
    assert session.undeclared.wait(10.0)
    assert keys["fleet/new/telemetry"] == 0
    declarer.close()
    assert session.declared == ["fleet/new/telemetry"]


@pytest.mark.parametrize("size", [512, 513])
def test_a_key_that_is_not_remembered_is_not_declared(size):
    session = FakeSession()
    declarer = KeyDeclarer(session)
    keys = SampleKeys(declarer.add)
    _ = keys["k" * size]
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
