"""Keys that were not used for long are given up, and no others."""

from socast.stream.idle_keys import IDLE_S, IdleKeys
from tests.support.service import Clock


def test_a_key_is_given_up_once_after_it_was_not_used_for_longer_than_the_limit():
    clock = Clock()
    keys = IdleKeys(10.0, clock)
    assert keys.use(["a", "b"]) == []
    clock.now += 10.0
    assert keys.use(["b"]) == []
    clock.now += 0.1
    assert keys.use([]) == ["a"]
    assert keys.use([]) == []
    clock.now += 10.0
    assert keys.use(["b", "c"]) == []


def test_the_default_limit_is_that_of_silent_cars():
    assert IDLE_S == 30 * 86_400.0
