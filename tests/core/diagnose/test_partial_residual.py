"""Test the data of the pictures of a diagnosis: partial residuals, profiles of the residual, and the falling error."""

from itertools import pairwise

import numpy as np
import pytest
from threadpoolctl import threadpool_limits

from socast.core import effects
from socast.core.diagnose.error_steps import compute_steps
from socast.core.diagnose.partial_residual import BINS, BINS_OF_CAR, compute_partial_residual
from socast.core.diagnose.residual_profile import profile_residual
from socast.core.stats.bin_means import average_in_bins, split_at_quantiles
from tests.support.selections import select_effects
from tests.support.synthetic_windows import make_tables, make_unknown, make_windows


@pytest.fixture(scope="module")
def selection():
    """Return a selection that has found a headwind of 5 % of the energy."""
    return select_effects(make_tables(make_windows(), {"headwind": 0.05}), "headwind")


@pytest.fixture(scope="module")
def picture(selection):
    with threadpool_limits(1):
        (finding,) = selection.effects
        return compute_partial_residual(selection, finding)


def test_points_before_lie_on_line_of_planted_coefficient(picture):
    x, before, half = map(np.array, (picture.x, picture.before, picture.ci95))
    assert len(x) == BINS
    assert (np.diff(x) > 0.0).all()
    inside = np.abs(before - picture.slope * x) < 1.5 * half
    assert inside.mean() >= 0.8
    assert np.polyfit(x, before, 1)[0] == pytest.approx(picture.slope, rel=0.1)
    assert max(abs(before)) > 5.0 * max(abs(np.array(picture.after)))
    assert np.array(picture.after) == pytest.approx(before - picture.slope * x)


def test_counts_cover_all_moving_windows(selection, picture):
    seen = selection.base.windows
    assert sum(picture.windows) == len(seen.table)
    assert sum(sum(car.windows) for car in picture.cars) == len(seen.table)
    assert all(1 <= days <= windows for days, windows in zip(picture.days, picture.windows, strict=True))


def test_every_car_shows_the_coefficient_alone(picture):
    assert [car.car for car in picture.cars] == sorted(car.car for car in picture.cars)
    assert len(picture.cars) == 4
    for car in picture.cars:
        low, high = car.slope_ci95
        assert low - 0.5 * (high - low) < picture.slope < high + 0.5 * (high - low)
        assert len(car.x) <= BINS_OF_CAR
    low, high = picture.slope_ci95
    assert low < picture.slope < high


def test_effect_of_time_is_shown_as_power():
    found = select_effects(make_tables(make_windows(), {"solar_load": 0.05}), "solar_load")
    (finding,) = found.effects
    shown = compute_partial_residual(found, finding)
    assert (shown.per, shown.unit) == ("h", effects.get("solar_load").unit)
    assert shown.x[0] == 0.0  # the night has a bin of its own


def test_profile_shows_unknown_cause_along_its_feature():
    found = select_effects(make_tables(make_windows(), unknown=make_unknown("crowded")))
    parts = {each.feature: each for each in profile_residual(found)}
    assert {"ambient_c", "occupants", "average_speed_kmh", "vehicle_id", "hour"} <= set(parts)
    for each in parts.values():
        assert (
            len({len(getattr(each, name)) for name in ("x", "before_w", "after_w", "ci95_w", "windows", "days")}) == 1
        )
        assert len(each.x) >= 2
        assert list(each.x) == sorted(each.x)
    crowd = parts["occupants"]
    assert crowd.after_w == crowd.before_w
    assert crowd.after_w[-1] - crowd.ci95_w[-1] > 0.0 > crowd.after_w[0] + crowd.ci95_w[0]


def test_profile_is_flat_once_the_cause_is_selected(selection):
    (wind,) = (each for each in profile_residual(selection) if each.feature == "wind_speed_kmh")
    spread = [half for half in wind.ci95_w if half is not None]
    assert len(spread) == len(wind.x)
    assert np.mean(np.abs(wind.after_w) < np.array(spread)) >= 0.75


def test_steps_have_intervals(selection):
    first, then = compute_steps(selection, 0.01)
    assert (first.effect, first.change_kwh, then.effect) == (None, None, "headwind")
    assert then.change_kwh == pytest.approx(then.mae_kwh - first.mae_kwh)
    assert then.change_kwh + then.change_ci95_kwh < 0.0 < first.mae_ci95_kwh < first.mae_kwh


def test_interval_of_bin_mean_has_its_coverage():
    rng = np.random.default_rng(4)
    days, per_day, repeats = 30, 10, 300
    day = np.repeat(np.arange(days), per_day)
    covered = 0
    for _ in range(repeats):
        values = rng.normal(size=days)[day] + rng.normal(size=days * per_day)
        means = average_in_bins(np.zeros(len(day), dtype=np.int64), 1, values, np.ones(len(day)), day)
        covered += abs(means.value[0]) < means.ci95[0]
    assert 0.91 < covered / repeats < 0.985


def test_bin_of_one_day_has_no_interval():
    place, day = np.array([0, 0, 1, 1, 1, 1]), np.array([0, 0, 0, 1, 2, 3])
    means = average_in_bins(place, 2, np.arange(6.0), np.ones(6), day)
    assert np.isnan(means.ci95[0])
    assert means.ci95[1] > 0.0
    assert means.days.tolist() == [1, 4]


@pytest.mark.parametrize("shift", [-3.0, 0.0, 3.0])
def test_bins_follow_the_order_of_values_with_zero_apart(shift):
    rng = np.random.default_rng(1)
    values = np.where(rng.random(500) < 0.4, 0.0, rng.normal(shift, 2.0, 500))
    place, bins = split_at_quantiles(values, 8)
    assert 2 <= bins <= 9
    assert len(set(place[values == 0.0])) == 1
    assert not set(place[values == 0.0]) & set(place[values != 0.0])
    ends = [(values[place == k].min(), values[place == k].max()) for k in range(bins)]
    assert all(before[1] < after[0] for before, after in pairwise(ends))
