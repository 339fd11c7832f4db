"""The compiled smoother gives the path of filterpy's, and the evidence of a shock of the dense Gaussian model."""

import numpy as np
import pytest
from filterpy.kalman import KalmanFilter

from socast.core.condition.level_smoother import smooth_level

VARIANCES = 0.3**2, 1e-5, 1e-8
START = 0.02
DATES = np.array([0, 1, 2, 5, 9, 10, 11, 30, 31, 33])
GAPS = np.diff(DATES, prepend=0).astype(float)
SHOCKS = np.where(DATES == 9, 0.06**2, 0.0)


def make_values():
    rng = np.random.default_rng(3)
    value = rng.normal(0.1, 0.05, len(DATES)) + np.where(DATES >= 9, 0.1, 0.0)
    value[3] = np.nan
    return value, rng.uniform(0.01, 0.05, len(DATES)) ** 2


def test_path_is_that_of_filterpy():
    value, noise = make_values()
    car = KalmanFilter(dim_x=2, dim_z=1)
    car.x, car.P = np.array([[START], [0.0]]), np.diag([VARIANCES[0], VARIANCES[2]])
    car.H = np.array([[1.0, 0.0]])
    moves = [np.array([[1.0, gap], [0.0, 1.0]]) for gap in GAPS]
    changes = [np.diag([VARIANCES[1] * gap + shock, 0.0]) for gap, shock in zip(GAPS, SHOCKS, strict=True)]
    values = [None if np.isnan(each) else each for each in value]
    means, covariances, _, _ = car.batch_filter(values, Fs=moves, Qs=changes, Rs=noise.tolist())
    means, covariances, _, _ = car.rts_smoother(means, covariances, Fs=moves, Qs=changes)
    path = smooth_level(value, noise, GAPS, SHOCKS, start=START, variances=VARIANCES)
    assert path.level == pytest.approx(means[:, 0, 0], abs=1e-12)
    assert path.rate == pytest.approx(means[:, 1, 0], abs=1e-12)
    assert path.variance == pytest.approx(covariances[:, 0, 0], rel=1e-9)
    assert path.rate_variance == pytest.approx(covariances[:, 1, 1], rel=1e-9)


def test_evidence_of_a_shock_is_that_of_the_dense_gaussian_model():
    value, noise = make_values()
    known, after = np.isfinite(value), SHOCKS.cumsum() > 0.0
    covariance = VARIANCES[0] + VARIANCES[1] * np.minimum.outer(DATES, DATES) + VARIANCES[2] * np.outer(DATES, DATES)
    covariance = (covariance + 0.06**2 * np.outer(after, after) + np.diag(noise))[np.ix_(known, known)]
    car = smooth_level(value, noise, GAPS, SHOCKS, start=START, variances=VARIANCES)
    for place, since in enumerate(DATES):
        step = (since <= DATES)[known].astype(float)
        weighted = np.linalg.solve(covariance, step)
        assert car.score[place] == pytest.approx(weighted @ (value[known] - START), rel=1e-9)
        assert car.information[place] == pytest.approx(weighted @ step, rel=1e-9)
