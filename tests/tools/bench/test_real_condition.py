"""The measurement of real cars raises energies from a date on, and finds what it put in."""

import numpy as np
import pandas as pd
import pytest

from socast.core.fit.ride_blocks import ENERGY, parse_ride_date
from socast.core.models import EXTENDED_PHYSICAL
from socast.tools.bench.real_condition import compare_changed, find_step
from tests.support.planted_rides import noisy, physical_energy, rides

DAYS = 80
AT = parse_ride_date("2018-02-10").toordinal()


@pytest.fixture(scope="module")
def table():
    """Return three rides a day of one car, as the model predicts them but for noise."""
    made = rides(3 * DAYS, 3, ("nissan-leaf-2013",), cars=1)
    dates = np.datetime64("2018-01-01") + np.repeat(np.arange(DAYS), 3)
    made = made.assign(date=dates.astype(str))
    return noisy(made, physical_energy(made.assign(effect_aero_drag_wind=made["effect_aero_drag"])))


def list_driven(table):
    return np.array(sorted({parse_ride_date(each).toordinal() for each in table["date"]}))


def test_put_in_change_is_estimated_and_a_placebo_is_none(table):
    changed, placebo = (compare_changed(table, EXTENDED_PHYSICAL, AT, size) for size in (0.2, 0.0))
    assert changed.change == pytest.approx(0.2, abs=0.05)
    assert changed.is_shown
    assert changed.ci90[0] < 0.2 < changed.ci90[1]
    assert placebo.change == pytest.approx(0.0, abs=0.05)


def test_put_in_step_is_told_at_its_date(table):
    driven = list_driven(table)
    assert find_step(table, EXTENDED_PHYSICAL, driven, AT, 0.2) <= 1
    assert find_step(table, EXTENDED_PHYSICAL, driven, AT, 0.0) is None


def test_days_before_the_date_are_left_as_they_are(table):
    before = table.copy()
    find_step(table, EXTENDED_PHYSICAL, list_driven(table), AT, 0.2)
    pd.testing.assert_frame_equal(table[[ENERGY]], before[[ENERGY]])
