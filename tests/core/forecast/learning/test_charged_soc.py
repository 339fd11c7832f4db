"""Test what is learned of planned charges: an offset, a constant end, and nothing from what is unknown."""

import numpy as np
import pytest

from socast.core.forecast.learning.charged_soc import NOISE, ChargedSoc

PLANNED = np.array([0.6, 0.7, 0.8, 0.9])


def learned(outcomes, days=1):
    charged = ChargedSoc()
    for _ in range(days):
        charged.add_charges(outcomes)
        charged.apply_daily_update()
    return charged


def test_plan_counts_before_any_outcome():
    mean, variance = ChargedSoc().expect(PLANNED)
    assert mean == pytest.approx(PLANNED)
    assert (variance > NOISE.variance).all()


@pytest.mark.parametrize("slope", [0.0, -1.0])
def test_planted_offset_and_slope_are_recovered(slope):
    rng = np.random.default_rng(1)
    planned = rng.uniform(0.55, 0.9, 300)
    reached = planned - 0.07 + slope * (planned - 0.8) + rng.normal(0.0, 0.02, len(planned))
    charged = learned(list(zip(planned, reached, strict=True)))
    assert charged.expect(PLANNED)[0] == pytest.approx(PLANNED - 0.07 + slope * (PLANNED - 0.8), abs=0.01)
    assert np.sqrt(charged.expect(PLANNED)[1]) == pytest.approx(np.full(4, 0.02), rel=0.15)


def test_charging_that_often_ends_early_is_less_certain():
    even = learned([(0.8, 0.8)] * 20)
    early = learned([(0.8, 0.8), (0.8, 0.5)] * 10)
    assert early.expect(PLANNED)[0][2] < even.expect(PLANNED)[0][2]
    assert early.expect(PLANNED)[1][2] > 4.0 * even.expect(PLANNED)[1][2]


def test_unknown_outcomes_and_nothing_before_the_daily_update_teach():
    charged = learned([(np.nan, 0.9), (0.8, np.nan)])
    charged.add_charges([(0.8, 0.5)])
    assert charged.expect(PLANNED)[0] == pytest.approx(PLANNED)


def test_expected_charge_is_possible_and_the_state_is_kept():
    charged = learned([(0.95, 1.0), (0.5, 0.7)] * 20, days=3)
    assert (charged.expect(np.linspace(0.0, 1.0, 11))[0] <= 1.0).all()
    again = ChargedSoc()
    again.load(charged.dump())
    assert [each.tolist() for each in again.expect(PLANNED)] == [each.tolist() for each in charged.expect(PLANNED)]
