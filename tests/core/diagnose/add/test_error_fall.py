"""The error above the noise, the share of it that a step removed, and their intervals."""

import numpy as np
import pytest

from socast.core.diagnose.add.error_fall import measure_fall
from socast.core.diagnose.add.records import EffectTrial, ErrorFall, list_attempts
from socast.core.errors import ModelError
from socast.core.fit.measurement_noise import MEAN_OVER_SD

RIDES = 600
CLUSTERS = np.repeat(np.arange(RIDES // 3), 3)


def make_fall(before: float, after: float, noise: float = 0.05, seed: int = 2, *, stated: float = 1.0) -> ErrorFall:
    """Return the fall between models whose own errors have a spread, beside noise that is stated times a factor."""
    rng = np.random.default_rng(seed)
    measured, own = rng.normal(0.0, noise, RIDES), rng.normal(0.0, 1.0, RIDES)
    variance = np.full(RIDES, (stated * noise) ** 2)
    return measure_fall(measured, before * own, after * own, variance, CLUSTERS)


def test_error_above_the_noise_is_the_error_less_that_of_a_perfect_model():
    fall = make_fall(0.12, 0.0)
    assert fall.noise_kwh == pytest.approx(MEAN_OVER_SD * 0.05)
    assert fall.above_before_kwh.value == pytest.approx(fall.mae_before_kwh - fall.noise_kwh)
    assert fall.above_before_kwh.value == pytest.approx(MEAN_OVER_SD * (0.13 - 0.05), rel=0.1)


def test_perfect_model_removes_all_that_noise_does_not_explain():
    fall = make_fall(0.12, 0.0)
    assert fall.removed.low < 1.0 < fall.removed.high
    assert fall.is_noise_reached
    assert not fall.is_noise_overestimated


def test_share_removed_is_the_fall_over_the_error_above_the_noise():
    fall = make_fall(0.12, 0.08)
    share = (fall.mae_before_kwh - fall.mae_after_kwh) / (fall.mae_before_kwh - fall.noise_kwh)
    assert fall.removed.value == pytest.approx(share)
    assert 0.0 < fall.removed.low < share < fall.removed.high < 1.0
    assert not fall.is_noise_reached


def test_intervals_contain_the_truth_at_their_rate():
    """The mean absolute value of a Gaussian error is `MEAN_OVER_SD` times its spread."""
    truth = (0.13 - np.hypot(0.05, 0.08)) / (0.13 - 0.05)
    falls = [make_fall(0.12, 0.08, seed=seed) for seed in range(200)]
    held = [fall.removed.low < truth < fall.removed.high for fall in falls]
    assert 0.90 < np.mean(held) < 0.99
    above = [abs(fall.above_before_kwh.value - MEAN_OVER_SD * 0.08) < fall.above_before_kwh.ci95 for fall in falls]
    assert 0.90 < np.mean(above) < 0.99


def test_no_share_is_stated_where_nothing_beyond_noise_was_there():
    fall = make_fall(0.0, 0.0)
    assert fall.removed.value is None
    assert fall.is_noise_reached


def test_noise_above_the_error_is_overestimated_and_gives_no_share():
    fall = make_fall(0.05, 0.0, stated=1.6)
    assert fall.is_noise_overestimated
    assert not fall.is_noise_reached
    assert fall.removed.value is None


def test_unknown_noise_gives_the_error_alone():
    zeros = np.zeros(RIDES)
    fall = measure_fall(zeros, zeros + 0.2, zeros + 0.1, zeros * np.nan, CLUSTERS)
    assert fall.change_kwh.value == pytest.approx(-0.1)
    assert fall.noise_kwh is None
    assert fall.above_after_kwh.value is None


def test_ride_of_unknown_noise_has_the_mean_of_the_others():
    zeros, noise = np.zeros(RIDES), np.where(np.arange(RIDES) % 2, 0.01, np.nan)
    fall = measure_fall(zeros, zeros + 0.2, zeros + 0.1, noise, CLUSTERS)
    assert fall.noise_kwh == pytest.approx(MEAN_OVER_SD * 0.1)


def test_record_survives_the_history_of_a_model():
    trial = EffectTrial(action="add", effect="snow", of_effect=make_fall(0.12, 0.08), warnings=["too large"])
    entry = trial.to_entry()
    assert "warnings" not in entry
    [attempt] = list_attempts([{"action": "fit"}, entry])
    assert (attempt.effect, attempt.scope, attempt.of_effect) == ("snow", [], trial.of_effect)
    assert attempt.to_json() == entry
    assert attempt.final is None


def test_damaged_history_is_refused_in_one_line():
    with pytest.raises(ModelError, match=r"the history of the model is damaged: Expected .* `\$.of_effect") as raised:
        list_attempts([{"action": "add", "of_effect": {"mae_before_kwh": "?"}}])
    assert "\n" not in str(raised.value)
