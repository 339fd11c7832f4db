"""Test that a map learned from fixes has the elevation of the ground, and an honest uncertainty."""

import numpy as np
import pytest
from scipy.sparse.linalg import cg
from threadpoolctl import threadpool_info, threadpool_limits

from socast.core.cleaning.kernel import Cleaner
from socast.core.errors import RecordingError
from socast.core.fit import elevation_learning
from socast.core.fit.elevation_learning import join_fixes, learn_elevation, select_fixes
from socast.core.settings import Settings
from tests.support.ground import hills, hilly_drive, street_fixes
from tests.support.telemetry import decoded, telemetry, without


def errors(places):
    """Return the error of each place that fixes are nearest to, and its uncertainty. [m]"""
    truth = hills(places.row * places.step_latitude, places.column * places.step_longitude)
    some = places.fixes > 0
    return (places.elevation - truth)[some], places.sd[some]


@pytest.fixture(scope="module")
def learned():
    return learn_elevation(street_fixes(80, seed=1))


def test_map_is_more_accurate_than_a_fix_and_knows_how_much(learned):
    error, sd = errors(learned[0])
    assert np.sqrt(np.mean(error**2)) < 0.7
    assert 0.7 < np.sqrt(np.mean((error / sd) ** 2)) < 1.3
    assert learned[1].fix_sd == pytest.approx(2.0, rel=0.1)


def test_more_fixes_give_a_smaller_error(learned):
    few, _ = errors(learn_elevation(street_fixes(16, seed=2))[0])
    many, _ = errors(learned[0])
    assert np.sqrt(np.mean(many**2)) < 0.8 * np.sqrt(np.mean(few**2))


def test_same_fixes_give_the_same_map():
    one, other = (learn_elevation(street_fixes(12, seed=3))[0] for _ in range(2))
    assert one.digest() == other.digest()


def test_linear_algebra_runs_in_one_thread(monkeypatch):
    threads = []

    def solve(*arguments, **options):
        threads.extend(pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas")
        return cg(*arguments, **options)

    monkeypatch.setattr(elevation_learning, "cg", solve)
    with threadpool_limits(2):
        learn_elevation(street_fixes(12, seed=3))
    assert set(threads) == {1}


def test_map_does_not_depend_on_the_parity_of_days():
    fixes = street_fixes(12, seed=3)
    fixes = fixes._replace(day=fixes.ride // 2)
    one, other = (learn_elevation(fixes._replace(day=factor * fixes.day))[0] for factor in (1, 2))
    assert one.digest() == other.digest()


def test_offsets_of_cars_and_rides_do_not_enter_the_map():
    places, summary = learn_elevation(street_fixes(80, seed=4, offsets=(-30.0, 0.0, 10.0, 20.0), ride_sd=2.0))
    error, _ = errors(places)
    assert abs(error.mean()) < 2.0  # the datum is the mean of the loggers
    assert np.std(error) < 1.3
    assert 10.0 < summary.car_sd < 40.0
    assert 1.0 < summary.ride_sd < 3.5


def test_gross_errors_of_some_fixes_hardly_move_the_map(learned):
    error, _ = errors(learn_elevation(street_fixes(80, seed=1, error=-50.0))[0])
    assert np.sqrt(np.mean(error**2)) < 2.0 * np.sqrt(np.mean(errors(learned[0])[0] ** 2))


def test_place_with_two_levels_is_uncertain(learned):
    fixes = street_fixes(80, seed=1)
    places, count = np.unique(np.rint(np.stack([fixes.latitude, fixes.longitude]) / 8e-6), axis=1, return_counts=True)
    bridge = (places[:, count.argmax()] == np.rint(np.stack([fixes.latitude, fixes.longitude]) / 8e-6).T).all(axis=1)
    fixes.elevation[bridge & (fixes.ride % 4 < 2)] += 15.0
    at = fixes.latitude[bridge][:1], fixes.longitude[bridge][:1]
    after = learn_elevation(fixes)[0].find_ground(*at).variance
    assert not after < 3.0 * learned[0].find_ground(*at).variance  # NaN where too uncertain to be kept


def test_too_few_fixes_are_refused_with_the_remedy():
    with pytest.raises(RecordingError, match=r"^40 usable fixes .* takes 100: give recordings"):
        learn_elevation(street_fixes(1))


def test_equations_that_are_not_solved_are_an_error_with_the_remedy(monkeypatch):
    monkeypatch.setattr("socast.core.fit.elevation_learning.MOST_STEPS", 3)
    with pytest.raises(RecordingError, match=r"^no map: after 3 steps .* above 1e-05; learn from fewer days"):
        learn_elevation(street_fixes(12))


def test_unusable_fixes_are_left_out():
    columns = without(hilly_drive(100), "truth")
    columns["elevation_m"][10] = -32768.0
    columns["latitude_deg"][20] = np.nan
    columns["latitude_deg"][30] += 0.1
    columns["latitude_deg"][40] = columns["latitude_deg"][39]
    columns["elevation_m"][50] = np.nan
    batch = decoded(telemetry(columns))
    fixes = select_fixes(batch, Cleaner(Settings()).clean(batch, 1))
    left = set(range(1, 100)) - {10, 20, 30, 40, 50}
    kept = {round(value, 9) for value in fixes.latitude.tolist()}
    assert kept <= {round(value, 9) for value in batch.latitude[sorted(left)].tolist()}
    assert len(kept) >= len(left) - 2
    assert set(fixes.car.tolist()) == {0}
    both = join_fixes([fixes, fixes])
    assert len(both.day) == 2 * len(fixes.day)
