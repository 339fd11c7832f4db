"""Test contrasts: their standard error, and the score of a slice of one day."""

import numpy as np
import pytest

from socast.core.diagnose.slices.contrast import compute_contrast


def test_contrast_standard_error_matches_simulation():
    rng = np.random.default_rng(3)
    days, rides = 40, 6
    starts = np.arange(0, days * rides, rides)
    day = np.repeat(np.arange(days), rides)
    by_day, within = (day < 10)[None, :], (np.arange(days * rides) % 2 == 0)[None, :]
    result = []
    for _ in range(300):
        error = rng.normal(0.0, 1.0, days * rides) + rng.normal(0.0, 1.0, days)[day]
        result.append([compute_contrast(mask, error, starts) for mask in (by_day, within)])
    for i, expected in enumerate([np.sqrt(7.0 / 6.0 * (1 / 10 + 1 / 30)), np.sqrt(4.0 / 240.0)]):
        differences = np.array([each[i].difference[0] for each in result])
        errors = np.array([each[i].error[0] for each in result])
        assert np.std(differences) == pytest.approx(expected, rel=0.15)
        assert np.mean(errors) == pytest.approx(expected, rel=0.08)
        scores = np.array([each[i].score()[0] for each in result])
        assert np.mean(np.abs(scores) > 1.96) == pytest.approx(0.05, abs=0.035)


def test_slice_of_one_day_has_zero_score():
    inside = np.zeros((2, 60), dtype=bool)
    inside[0, :10] = True
    contrast = compute_contrast(inside, np.random.default_rng(0).normal(size=60), np.arange(0, 60, 10))
    assert contrast.freedom.tolist() == [0.0, 0.0]
    assert contrast.score().tolist() == [0.0, 0.0]
