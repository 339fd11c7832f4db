"""Stated probabilities are compared with how often they are right."""

from math import isnan
from xml.etree import ElementTree as ET

import numpy as np
import pytest

from socast.tools.bench.hidden.figures import (
    BOTTOM,
    LEFT,
    RIGHT,
    TOP,
    bin_probabilities,
    compute_calibration_error,
    draw_calibration_error,
    draw_reliability,
    tabulate_reliability,
)


def test_calibrated_probabilities_have_a_small_error():
    rng = np.random.default_rng(0)
    stated = rng.uniform(size=20_000)
    right = rng.uniform(size=20_000) < stated
    assert compute_calibration_error(list(zip(stated.tolist(), right.tolist(), strict=True))) < 0.02
    assert compute_calibration_error([(p, True) for p in stated.tolist()]) == pytest.approx(0.5, abs=0.02)


def test_bins_hold_the_ends_of_the_range():
    assert [(each.low, each.of, each.right) for each in bin_probabilities([(0.0, False), (1.0, True)])] == [
        (0.0, 1, 0.0),
        (0.9, 1, 1.0),
    ]
    assert isnan(compute_calibration_error([]))


def test_table_has_a_row_for_each_bin_with_names():
    assert tabulate_reliability([(0.95, True)] * 3)[2:] == ["| 90 to 100 % | 95 % | 100 % | 44 to 100 % | 3 |"]


def test_figure_places_each_bin_at_its_stated_and_right_share():
    drawn = ET.fromstring(draw_reliability([(0.75, True), (0.75, False), (0.5, True)]))
    points = [(float(c.get("cx")), float(c.get("cy"))) for c in drawn.iter() if c.tag.endswith("circle")]
    expected = [
        (LEFT + (RIGHT - LEFT) * stated, BOTTOM - (BOTTOM - TOP) * right) for stated, right in ((0.5, 1.0), (0.75, 0.5))
    ]
    assert points == [pytest.approx(place, abs=0.1) for place in expected]
    assert len(list(ET.fromstring(draw_reliability([])).iter())) > 5


def test_range_by_chance_holds_the_error_of_right_probabilities_and_narrows():
    rng = np.random.default_rng(5)
    held = 0
    for _ in range(20):
        stated = rng.uniform(size=60)
        names = list(zip(stated.tolist(), (rng.uniform(size=60) < stated).tolist(), strict=True))
        low, high = draw_calibration_error(names, draws=200)
        held += low <= compute_calibration_error(names) <= high
    assert held >= 16
    many = [(value, True) for value in rng.uniform(size=600).tolist()]
    assert draw_calibration_error(many, draws=100)[1] < 0.6 * high
    assert all(isnan(limit) for limit in draw_calibration_error([]))
