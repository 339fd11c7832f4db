"""Test that the time of receipt never freezes, and goes back only where the system clock was wrong for a minute."""

import itertools

import pytest
from hypothesis import given
from hypothesis import strategies as st

from socast.stream.receipt_clock import SETTLE_S, SLEW, STEP_S, ReceiptClock

SECOND = 1_000_000_000
UNIX = 1_700_000_000 * SECOND
HOUR, YEARS = 3600.0, 3.2e8


class Clocks:
    """Hold a monotonic clock, and a system clock with an error that a test sets."""

    def __init__(self) -> None:
        self.monotonic = 5 * SECOND
        self.error = 0

    def system_ns(self) -> int:
        return UNIX + self.monotonic + self.error

    def monotonic_ns(self) -> int:
        return self.monotonic

    def set_error(self, seconds: float) -> None:
        self.error = round(seconds * SECOND)

    def read_for(self, clock: ReceiptClock, seconds: float) -> list[int]:
        """Return one reading per second."""
        out = []
        for _ in range(round(seconds)):
            self.monotonic += SECOND
            out.append(clock.read_ns())
        return out


@pytest.fixture
def clocks() -> Clocks:
    return Clocks()


def make_clock(clocks: Clocks) -> ReceiptClock:
    return ReceiptClock(clocks.system_ns, clocks.monotonic_ns)


def test_undisturbed_clock_tells_the_system_time(clocks: Clocks):
    clock = make_clock(clocks)
    assert clocks.read_for(clock, 100)[-1] == clocks.system_ns()


@pytest.mark.parametrize("jump", [60.0, HOUR, YEARS, -HOUR])
def test_jump_forward_and_back_within_a_minute_changes_nothing(clocks: Clocks, jump: float):
    clock = make_clock(clocks)
    clocks.set_error(jump)
    told = clocks.read_for(clock, SETTLE_S - 5)
    clocks.set_error(0.0)
    told += clocks.read_for(clock, 100)
    assert {b - a for a, b in itertools.pairwise(told)} == {SECOND}
    assert told[-1] == clocks.system_ns()
    assert clock.steps == 0


@pytest.mark.parametrize("jump", [60.0, YEARS, -HOUR])
def test_clock_recovers_from_a_jump_that_was_believed(clocks: Clocks, jump: float):
    clock = make_clock(clocks)
    clocks.set_error(jump)
    assert clocks.read_for(clock, SETTLE_S + 5)[-1] == clocks.system_ns()
    clocks.set_error(0.0)
    assert clocks.read_for(clock, SETTLE_S + 5)[-1] == clocks.system_ns()
    assert clock.steps == 2


@pytest.mark.parametrize("error", [0.5, -0.5, 9.0, -9.0])
def test_small_correction_is_gradual_and_never_goes_back(clocks: Clocks, error: float):
    clock = make_clock(clocks)
    clocks.set_error(error)
    told = clocks.read_for(clock, abs(error) / SLEW + 2)
    steps = [b - a for a, b in itertools.pairwise(told)]
    assert min(steps) >= (1 - SLEW) * SECOND
    assert max(steps) <= (1 + SLEW) * SECOND
    assert told[-1] == clocks.system_ns()


def test_clock_that_jumps_again_and_again_is_not_followed(clocks: Clocks):
    clock = make_clock(clocks)
    told = []
    for at in range(20):
        clocks.set_error(HOUR * (1 + at % 3))
        told += clocks.read_for(clock, 30)
    assert clock.steps == 0
    assert {b - a for a, b in itertools.pairwise(told)} == {SECOND}


@given(errors=st.lists(st.floats(-STEP_S / 2, STEP_S / 2), min_size=1, max_size=30), wait=st.integers(0, 40))
def test_small_errors_never_let_the_time_of_receipt_decrease(errors: list[float], wait: int):
    clocks = Clocks()
    clock, told = make_clock(clocks), []
    for error in errors:
        clocks.set_error(error)
        told += [clock.read_ns(), *clocks.read_for(clock, wait)]
    assert told == sorted(told)
