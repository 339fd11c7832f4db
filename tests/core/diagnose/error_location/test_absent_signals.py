"""Test absent signals: those that most rides lack are listed with the number of rides that have them."""

import numpy as np
import pandas as pd
import pytest

from socast.core.diagnose.error_location.absent_signals import SIGNALS, count_absent_signals


def make_rides(known, total=31):
    """Return rides of which some have the climate power."""
    hvac = np.where(np.arange(total) < known, 0.1, np.nan)
    return pd.DataFrame({"hvac_kwh": hvac, "effect_climbing": 0.0, "driver_id": ["ann"] * total, "parked_s": 60.0})


@pytest.mark.parametrize(("known", "absent"), [(0, True), (15, True), (16, False), (31, False)])
def test_signal_of_less_than_half_of_the_rides_is_absent_with_its_count(known, absent):
    found = count_absent_signals(make_rides(known))
    assert found.get("climate power") == (known if absent else None)
    assert {"driver", "time parked"} & set(found) == set()


def test_missing_column_and_level_ground_are_known_in_no_ride():
    found = count_absent_signals(make_rides(31))
    assert (found["wind"], found["elevation"]) == (0, 0)


def test_no_rides_lack_nothing():
    assert count_absent_signals(make_rides(0, 0)) == {}
    assert set(count_absent_signals(make_rides(0))) < set(SIGNALS)
