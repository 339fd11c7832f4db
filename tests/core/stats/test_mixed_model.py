"""Test the mixed model against dense matrices of the same model."""

import numpy as np
import pytest
from scipy.linalg import block_diag

from socast.core.stats.mixed_model import FixedColumns, MixedModel
from socast.core.stats.random_effects import integrate_out, sum_products, sum_units
from socast.core.stats.variances import estimate_variances, find_interval

CARS, DATES, RIDES, WINDOWS, EFFECTS = 3, 5, 3, 4, 2
N = CARS * DATES * RIDES * WINDOWS


def codes():
    """Return the car, the date, the vehicle-day and the ride of each window, ordered by car."""
    at = np.arange(N)
    ride = at // WINDOWS
    day = ride // RIDES
    return day // DATES, day % DATES, day, ride


def make_case(seed=1):
    """Return effects, fixed columns with one car lacking a column, the same dense, energies and weights."""
    rng = np.random.default_rng(seed)
    car, date, day, ride = codes()
    effects = np.column_stack([rng.uniform(0.5, 1.5, N), rng.normal(0.0, 1.0, N)])
    own, shared = rng.normal(0.0, 1.0, (N, 2)), rng.normal(0.0, 1.0, (N, 1))
    own[car == 2, 1] = 0.0
    place = np.array([[0, 1, 5], [2, 3, 5], [4, -1, 5]])
    dense = np.column_stack([own * (car == c)[:, np.newaxis] for c in range(CARS)] + [shared])
    dense = dense[:, np.abs(dense).sum(axis=0) > 0.0]
    weight = rng.uniform(0.5, 2.0, N)
    energy = dense @ rng.normal(0.0, 1.0, 6) + rng.normal(0.0, 1.0, N) / np.sqrt(weight)
    for code, deviation in ((ride, 0.7), (day, 0.5), (date, 0.6)):
        energy += (rng.normal(0.0, deviation, (code.max() + 1, EFFECTS))[code] * effects).sum(axis=1)
    return effects, FixedColumns(np.column_stack([own, shared]), car, place), dense, energy, weight


def compute_dense_criterion(effects, dense, energy, weight, levels, relative):
    """Return minus twice the logarithm of the restricted likelihood, with φ profiled out, and the covariance over φ."""
    covariance = np.diag(1.0 / weight)
    for code, variance in zip(levels, relative, strict=True):
        for k, each in enumerate(variance):
            same = code[:, np.newaxis] == code
            covariance += each * same * np.outer(effects[:, k], effects[:, k])
    inverse = np.linalg.inv(covariance)
    information = dense.T @ inverse @ dense
    b = np.linalg.solve(information, dense.T @ inverse @ energy)
    left = energy - dense @ b
    rss = left @ inverse @ left
    freedom = len(energy) - dense.shape[1]
    logarithms = np.linalg.slogdet(covariance)[1] + np.linalg.slogdet(information)[1] + np.log(weight).sum()
    return freedom * np.log(rss) + logarithms, covariance, left


LEVELS = {
    "rides": ("ride",),
    "days": ("ride", "day"),
    "cars": ("ride", "day", "car"),
    "dates that span cars": ("ride", "day", "date"),
}


@pytest.fixture(params=LEVELS)
def case(request):
    effects, fixed, dense, energy, weight = make_case()
    of = dict(zip(("car", "date", "day", "ride"), codes(), strict=True))
    levels = [of[name] for name in LEVELS[request.param]]
    return MixedModel(effects, fixed, energy, weight, levels), (effects, dense, energy, weight, levels)


@pytest.mark.parametrize("seed", range(4))
def test_criterion_equals_dense_likelihood(case, seed):
    model, dense = case
    relative = np.random.default_rng(seed).exponential(0.5, (len(dense[-1]), EFFECTS))
    relative[0, seed % EFFECTS] = 0.0
    expected, *_ = compute_dense_criterion(*dense, relative)
    assert model.evaluate(relative).value == pytest.approx(expected, abs=1e-8)


@pytest.mark.parametrize("seed", range(3))
def test_gradient_equals_finite_differences(case, seed):
    model, dense = case
    relative = np.random.default_rng(seed).exponential(0.5, (len(dense[-1]), EFFECTS))
    found = model.evaluate(relative).gradient
    step = 1e-5
    for at in np.ndindex(relative.shape):
        more, less = relative.copy(), relative.copy()
        more[at], less[at] = relative[at] + step, relative[at] - step
        expected = (model.evaluate(more).value - model.evaluate(less).value) / (2.0 * step)
        assert found[at] == pytest.approx(expected, rel=1e-6, abs=1e-6)


def test_expected_effects_are_those_of_the_dense_model(case):
    model, dense = case
    effects, _, _, _, levels = dense
    relative = np.random.default_rng(5).exponential(0.5, (len(levels), EFFECTS))
    _, covariance, left = compute_dense_criterion(*dense, relative)
    pulled = np.linalg.solve(covariance, left)
    for code, variance, found in zip(levels, relative, model.expect_effects(relative), strict=True):
        for k in range(EFFECTS):
            expected = variance[k] * np.bincount(code, effects[:, k] * pulled)
            np.testing.assert_allclose(found[:, k], expected, atol=1e-9)


def test_variances_of_no_benefit_are_exactly_zero():
    effects, fixed, dense, _, weight = make_case()
    *_, day, ride = codes()
    energy = dense @ np.ones(6) + np.random.default_rng(3).normal(0.0, 1.0, N) / np.sqrt(weight)
    model = MixedModel(effects, fixed, energy, weight, [ride, day])
    found = estimate_variances(model, np.ones((2, EFFECTS), dtype=bool))
    at_zero = found.relative == 0.0
    assert at_zero.any()
    assert (found.criterion.gradient[at_zero] >= 0.0).all()
    flat = found.criterion.gradient * model.find_errors(found.relative)
    assert np.abs(flat[~at_zero]).max(initial=0.0) < 0.2


def test_model_of_kept_effects_equals_model_without_the_others(case):
    model, (effects, dense, energy, weight, levels) = case
    relative = np.full((len(levels), 1), 0.3)
    expected, *_ = compute_dense_criterion(effects[:, 1:], dense, energy, weight, levels, relative)
    assert model.keep([1]).evaluate(relative).value == pytest.approx(expected, abs=1e-8)


def test_condensed_model_has_the_criterion_of_the_whole_up_to_a_constant(case):
    model, (*_, levels) = case
    lower = np.random.default_rng(4).exponential(0.5, (len(levels) - 1, EFFECTS))
    condensed = model.condense(lower)
    tops = np.array([[[0.2, 0.0]], [[0.7, 0.4]]])
    whole = [model.evaluate(np.vstack([lower, top])) for top in tops]
    alone = [condensed.evaluate(top) for top in tops]
    assert alone[1].value - alone[0].value == pytest.approx(whole[1].value - whole[0].value, abs=1e-8)
    np.testing.assert_allclose(alone[1].gradient[0], whole[1].gradient[-1], rtol=1e-8)


def test_interval_ends_where_the_profile_rises_by_the_quantile(case):
    model, dense = case
    free = np.ones((len(dense[-1]), EFFECTS), dtype=bool)
    best = estimate_variances(model, free)
    at = tuple(int(i) for i in np.argwhere(best.relative == best.relative.max())[0])
    low, high = find_interval(model, best, free, at)
    assert low < best.deviations[at] < high
    others = free.copy()
    others[at] = False
    for end in (low, high):
        if end == 0.0:
            continue
        scale = best.criterion.scale
        for _ in range(30):  # the end is a standard deviation, at the φ of the same point
            start = best.relative.copy()
            start[at] = end**2 / scale
            found = estimate_variances(model, others, start)
            scale = found.criterion.scale
        assert found.criterion.value - best.criterion.value == pytest.approx(3.84, abs=0.2)


def test_planted_deviations_are_recovered():
    rng = np.random.default_rng(8)
    ride = np.repeat(np.arange(300), 8)
    effects = np.column_stack([np.ones(len(ride)), rng.uniform(0.0, 2.0, len(ride))])
    energy = effects[:, 0] * rng.normal(0.0, 0.5, 300)[ride] + rng.normal(0.0, 1.0, len(ride))
    common = FixedColumns(effects, np.zeros(len(effects), dtype=np.int64), np.arange(effects.shape[1])[np.newaxis])
    model = MixedModel(effects, common, energy, np.ones(len(ride)), [ride])
    free = np.ones((1, 2), dtype=bool)
    best = estimate_variances(model, free)
    low, high = find_interval(model, best, free, (0, 0))
    assert best.deviations[0, 0] == pytest.approx(0.5, abs=0.08)
    assert low < 0.5 < high
    assert best.deviations[0, 1] < 0.12


def test_levels_that_are_not_nested_are_refused():
    effects, fixed, _, energy, weight = make_case()
    _, date, day, ride = codes()
    with pytest.raises(ValueError, match="nested"):
        MixedModel(effects, fixed, energy, weight, [ride, date, day])


def test_sweep_equals_covariance_of_random_effects():
    """Sums after the sweep are those under the covariance with the effects, and so is the determinant."""
    rng = np.random.default_rng(2)
    columns, weight, variance = rng.normal(size=(12, 4)), rng.uniform(0.5, 2.0, 12), np.array([0.3, 0.0])
    ride = np.repeat([0, 1], 6)
    swept = integrate_out(sum_products(columns, weight, ride), np.array([2, 0]), variance)
    for r in range(2):
        q = columns[ride == r]
        covariance = np.diag(1.0 / weight[ride == r]) + q[:, [2, 0]] * variance @ q[:, [2, 0]].T
        np.testing.assert_allclose(swept.sums[r], q.T @ np.linalg.solve(covariance, q), atol=1e-10)
        determinant = np.linalg.slogdet(covariance)[1] + np.log(weight[ride == r]).sum()
        assert swept.log_determinant[r] == pytest.approx(determinant)


def test_sums_of_units_do_not_depend_on_their_order():
    sums, parent = np.random.default_rng(1).normal(size=(6, 2, 2)), np.array([2, 0, 1, 0, 2, 2])
    expected = [sums[parent == p].sum(axis=0) for p in range(3)]
    np.testing.assert_allclose(sum_units(sums, parent), expected)
    np.testing.assert_allclose(block_diag(*sum_products(np.eye(2), np.ones(2), np.array([0, 1])))[0], [1, 0, 0, 0])


def test_collinear_fixed_columns_change_neither_scale_nor_variances():
    """A column that all cars share and that their own columns span adds nothing."""
    effects, fixed, _, energy, weight = make_case()
    car, _, day, ride = codes()
    spanned = fixed.columns[:, [0]]
    more = FixedColumns(np.column_stack([fixed.columns, spanned]), car, np.column_stack([fixed.place, [6, 6, 6]]))
    plain, collinear = (MixedModel(effects, each, energy, weight, [ride, day]) for each in (fixed, more))
    assert collinear.freedom == plain.freedom
    for relative in (np.zeros((2, EFFECTS)), np.full((2, EFFECTS), 0.3)):
        one, other = plain.evaluate(relative), collinear.evaluate(relative)
        assert other.scale == pytest.approx(one.scale, rel=1e-9)
        np.testing.assert_allclose(other.gradient, one.gradient, rtol=1e-6, atol=1e-9)
    free = np.ones((2, EFFECTS), dtype=bool)
    expected = estimate_variances(plain, free).deviations
    np.testing.assert_allclose(estimate_variances(collinear, free).deviations, expected, rtol=1e-3, atol=1e-3)
