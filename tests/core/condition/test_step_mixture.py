"""The mixture of shocks in one pass is that of the smoother run for each shock."""

import numpy as np
import pytest

from socast.core.condition.level_smoother import smooth_level
from socast.core.condition.step_mixture import NO_SHOCK, mix_shocks

VARIANCES = 0.3**2, 1e-5, 1e-8
SHOCK = 0.06**2
DATES = np.array([0, 1, 2, 5, 9, 10, 11, 30, 31, 33, 34, 40])
GAPS = np.diff(DATES, prepend=0).astype(float)
BROKEN = np.where(DATES == 9, 0.3**2, 0.0)
PLACES = np.array([2, 6, 7, 10])


def test_mixture_is_that_of_a_smoother_for_each_shock():
    rng = np.random.default_rng(3)
    value = rng.normal(0.1, 0.05, len(DATES)) + np.where(DATES >= 30, 0.1, 0.0)
    value[[3, 11]] = np.nan
    noise = rng.uniform(0.01, 0.05, len(DATES)) ** 2

    def smooth(extra):
        return smooth_level(value, noise, GAPS, BROKEN + extra, start=0.02, variances=VARIANCES)

    plain = smooth(0.0)
    runs = [plain, *(smooth(SHOCK * (np.arange(len(DATES)) == place)) for place in PLACES)]
    chances = np.array([0.1, 0.2, 0.15, 0.05])
    precise = plain.information[PLACES] + 1.0 / SHOCK
    of_steps = chances, plain.score[PLACES] / precise, 1.0 / precise
    added = mix_shocks(np.isfinite(value), noise, GAPS, BROKEN, VARIANCES, PLACES, *of_steps)
    weights = np.array([1.0 - chances.sum(), *chances])
    means, variances = (np.array([getattr(run, name) for run in runs]) for name in ("level", "variance"))
    mean = weights @ means
    assert plain.level + added.level == pytest.approx(mean, abs=1e-12)
    assert variances[0] + added.variance == pytest.approx(weights @ (variances + (means - mean) ** 2), rel=1e-9)


def test_nothing_is_added_without_a_shock():
    none, nothing = np.array([], dtype=np.int64), np.zeros(0)
    added = mix_shocks(
        np.ones(3, np.bool_), np.ones(3), np.ones(3), np.zeros(3), VARIANCES, none, nothing, nothing, nothing
    )
    assert all(np.all(one == other) for one, other in zip(added, NO_SHOCK, strict=True))
