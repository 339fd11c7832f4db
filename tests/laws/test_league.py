"""Test that no fault of a logger, alone or beside another, makes a ride that is fit for training and wrong."""

import random
from functools import cache
from itertools import combinations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from socast.tools.bench.league.faults import FAULTS
from socast.tools.bench.league.fleet import find_difference, judge_stream, make_entry
from socast.tools.bench.league.laws import REPAIRED, RIGHT, WRONG
from socast.tools.bench.league.loggers import are_compatible

pytestmark = pytest.mark.long

HARMLESS = (
    *("clock_jitter", "clock_set_forward", "clock_set_back", "clock_floored_1_s", "clock_week_rollover", "clock_drift"),
    *("clock_summer_time", "counter_absent", "counter_restarts", "counter_kept_asleep", "sent_twice", "sent_late"),
    *("samples_lost", "samples_lost_for_a_minute", "every_1_s", "every_10_s", "every_60_s", "speed_noisy"),
    *("speed_spikes", "position_noisy", "position_absent", "position_drift_parked", "position_zero"),
    *("charging_unflagged", "odometer_absent", "odometer_coarse"),
)
"""Faults that cost nothing: each drive stays fit for training."""
SEED, CARS = 11, 2
"""Seed of the cars, and number of cars that have each fault."""


def drive(names, cars=range(CARS), seed=SEED):
    """Yield what became of each drive of cars, each of which has the stream to itself."""
    for number in cars:
        yield from judge_stream([make_entry(seed, number, [FAULTS[name] for name in names])])


@cache
def drive_alone(name):
    """Return what became of each drive of some cars that have one fault."""
    return tuple(drive([name]))


def tell(verdicts):
    """Return what is wrong, in a form that an assertion shows."""
    return [(each.car, each.drive, each.why, each.found, each.truth) for each in verdicts if each.word == WRONG]


def test_every_drive_without_a_fault_is_fit_and_right():
    assert {each.word for each in drive((), range(4))} <= {RIGHT, REPAIRED}


@pytest.mark.parametrize("name", FAULTS)
def test_at_most_one_drive_with_a_fault_is_fit_and_wrong(name):
    """This is a sample of two cars a fault; `docs/reference/league.md` states how many of thousands of drives are."""
    assert len(tell(drive_alone(name))) <= 1


def test_one_drive_in_a_hundred_with_a_fault_is_fit_and_wrong_at_most():
    verdicts = [each for name in FAULTS for each in drive_alone(name)]
    assert len(tell(verdicts)) <= 0.01 * len(verdicts)


@pytest.mark.parametrize("name", HARMLESS)
def test_every_drive_with_a_harmless_fault_stays_fit_and_right(name):
    assert {each.word for each in drive_alone(name)} <= {RIGHT, REPAIRED}


PAIRS = [(one, other) for one, other in combinations(FAULTS, 2) if are_compatible(FAULTS[one], FAULTS[other])]


def test_few_drives_with_two_faults_are_fit_and_wrong():
    chosen = random.Random(SEED).sample(PAIRS, 24)
    words = [each.word for number, pair in enumerate(chosen) for each in drive(pair, range(1), number)]
    assert words.count(WRONG) <= 0.05 * len(words)


@settings(max_examples=3)
@given(seed=st.integers(0, 50))
def test_cars_with_wrong_clocks_do_not_change_what_becomes_of_others(seed):
    healthy = [make_entry(seed, number, []) for number in range(3)]
    bad = ("clock_bursts", "clock_floored_60_s", "clock_set_forward", "clock_week_rollover", "clock_drift")
    others = [make_entry(seed, 3 + number, [FAULTS[name]]) for number, name in enumerate(bad)]
    together = [each for each in judge_stream([*healthy, *others]) if not each.faults]
    assert not tell(together)


@settings(max_examples=4)
@given(seed=st.integers(0, 50))
def test_any_chunking_of_faulty_streams_gives_the_same_bytes(seed):
    assert not find_difference(seed, [2 * seed + 1])
