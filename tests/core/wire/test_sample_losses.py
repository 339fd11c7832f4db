"""Lost samples are counted by the counter of the logger, else by its period."""

import numpy as np
import pytest

from socast.core.pipeline import Pipeline
from tests.support.faulty_shifts import shift
from tests.support.telemetry import drive, telemetry


def count_lost(columns, keep, order=None) -> tuple[int, int]:
    """Return how many samples of a drive came and are lost, if only those with the numbers `keep` come."""
    messages = [telemetry(columns)[i] for i in (keep if order is None else order)]
    pipeline = Pipeline()
    pipeline.take(messages)
    losses = pipeline.decoder.losses
    return int(losses.received().sum()), int(losses.lost().sum())


def without(count: int, *missing: range) -> list[int]:
    gone = {i for part in missing for i in part}
    return [i for i in range(count) if i not in gone]


@pytest.mark.parametrize("counter", [True, False])
def test_gaps_are_lost(counter):
    columns = drive(300, speed=10.0)
    if not counter:
        columns.pop("seq", None)
    elif "seq" not in columns:
        columns["seq"] = np.arange(300)
    keep = without(300, range(50, 53), range(100, 190))
    assert count_lost(columns, keep) == (207, 93)


def test_samples_that_come_late_are_not_lost():
    columns = drive(100, speed=10.0) | {"seq": np.arange(100)}
    order = [*range(40), *range(60, 70), *range(40, 60), *range(70, 100)]
    assert count_lost(columns, [], order) == (100, 0)


def test_power_cycle_costs_nothing_and_a_leap_of_one_sample_neither():
    columns = drive(100, speed=10.0) | {"seq": np.arange(100)}
    columns["seq"][50:] = np.arange(50)
    assert count_lost(columns, range(100)) == (100, 0)
    columns["seq"] = np.arange(100)
    columns["seq"][70] = 10**9
    assert count_lost(columns, range(100))[1] in {0, 1}


def test_silence_without_a_counter_is_a_logger_that_was_off():
    columns = drive(100, speed=10.0)
    columns.pop("seq", None)
    columns["time_s"] = columns["time_s"] + 3600.0 * (np.arange(100) >= 50)
    assert count_lost(columns, range(100)) == (100, 0)


def test_counts_survive_a_restart_and_any_division():
    messages, whole = shift(4), Pipeline()
    whole.take(messages)
    parts = Pipeline()
    for start in range(0, len(messages), 37):
        again = Pipeline()
        again.restore(parts.snapshot())
        parts = again
        parts.take(messages[start : start + 37])
    assert parts.decoder.dump() == whole.decoder.dump()
    assert parts.quality()["lost"] == whole.quality()["lost"]
