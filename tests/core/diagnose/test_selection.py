"""Test what is named: planted effects without decoys, nothing where nothing is planted, twins with their causes."""

from copy import copy
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest

from socast.core import effects
from socast.core.diagnose.inference.posterior import LikelyCause, Size
from socast.core.diagnose.projection import BaseProjection
from socast.core.diagnose.selection import Selection, list_missing, select_missing
from socast.core.stats.evidence import ClusterSums
from socast.core.stats.scores import Estimate, compute_half_widths
from tests.support.inferences import infer
from tests.support.selections import select_effects
from tests.support.synthetic_windows import compute_coefficients, make_tables, make_windows

pytestmark = pytest.mark.long

LEAST_GAIN = 0.002
PLAUSIBLE = {
    "cold_rolling": 0.06,
    "headwind": 0.055,
    "wet_road": 0.055,
    "night_lights": 0.021,
    "regen_full_battery": 0.035,
    "cornering": 0.042,
}
"""Shares of the energy of planted effects, with coefficients in their plausible ranges."""
PAIRS = (("headwind", "cold_rolling"), ("wet_road", "night_lights"), ("regen_full_battery", "cornering"))


@cache
def select(*planted: tuple[str, float], least_gain=0.0, **errors) -> Selection:
    """Return the missing effects of synthetic cars with planted effects, given with their shares of the energy."""
    tables = make_tables(make_windows(), dict(planted), **({"of_day": 0.02} | errors))
    windows, model, found = infer(tables)
    clusters = [ClusterSums(windows.day), ClusterSums(windows.date)]
    return select_missing(BaseProjection(windows, model), found, clusters, 0, least_gain)


def list_names(selection: Selection) -> list[str]:
    return [each.effect for each in selection.effects]


@pytest.mark.parametrize("effect", PLAUSIBLE)
def test_planted_effect_is_named_without_decoys(effect):
    share = PLAUSIBLE[effect]
    selection = select((effect, share))
    assert list_names(selection) == [effect]
    (finding,) = selection.effects
    half = compute_half_widths(finding.size.error, finding.size.freedom, 0.999)
    if "@" not in finding.variant:
        assert abs(compute_coefficients(make_windows(), {effect: share})[effect] - finding.size.value) < half
    assert finding.gain.value > LEAST_GAIN
    assert finding.gain.value > finding.gain.ci95
    assert finding.probability > 0.7


@pytest.mark.parametrize(
    "variant", ["cold_rolling@reference=283.15", "wet_road@depth=0.0001", "regen_full_battery@threshold=0.8"]
)
def test_effect_of_a_variant_is_named_by_its_effect(variant):
    assert list_names(select((variant, 0.08), of_day=0.0)) == [variant.partition("@")[0]]


@pytest.mark.parametrize("pair", PAIRS)
def test_two_planted_effects_are_both_named(pair):
    assert set(list_names(select(*((name, min(PLAUSIBLE[name], 0.05)) for name in pair), of_day=0.01))) == set(pair)


def test_effect_below_the_least_gain_is_left_out():
    assert list_names(select(("headwind", 0.05), least_gain=0.99)) == []


@pytest.mark.parametrize(("share", "is_missing"), [(0.019, False), (0.021, True)])
def test_effect_below_its_plausible_coefficients_is_missing_where_it_takes_a_large_share(share, is_missing):
    measured, column = np.ones(50), np.full(50, 0.1)
    size = Size(Estimate(share / 0.1, 0.001, 40.0), 1.0)
    assert size.estimate.value < effects.get("cabin_heating").low
    family = SimpleNamespace(is_scoped=False, lowest=0.0)
    cause = LikelyCause(family, 0.99, 9.0, "cabin_heating", size, {"cabin_heating": 1.0}, {0: 1.0}, 0, column)
    inference = SimpleNamespace(findings=(cause,), expected=(), columns=SimpleNamespace(measured=measured))
    assert [each.effect for each in list_missing(inference)] == ["cabin_heating"] * is_missing


def test_selection_is_reproducible():
    first = select(*((name, 0.05) for name in PAIRS[0]), of_day=0.01)
    again = select.__wrapped__(*((name, 0.05) for name in PAIRS[0]), of_day=0.01)
    assert [(each.variant, each.size, each.gain, each.causes) for each in first.effects] == [
        (each.variant, each.size, each.gain, each.causes) for each in again.effects
    ]


def test_gain_of_an_implausible_coefficient_is_that_of_the_largest_plausible_one():
    selection = select_effects(make_tables(make_windows()), "cabin_heating")
    (finding,) = selection.effects
    low, high = finding.limits
    assert (low, high) == (0.0, effects.get("cabin_heating").high)
    column = selection.base.project_out(finding.column)[:, 0]
    alone = selection.keep(())

    def compute(factor: float) -> Estimate:
        base = copy(selection.base)
        base.residual = factor * high * column
        return alone.on(base).compute_gain(finding)

    assert compute(2.0).value == pytest.approx(1.0 - 0.5**2)
    assert compute(0.5).value == pytest.approx(1.0)
    assert compute(-1.0).value == 0.0


def test_selected_effects_are_projected_off_the_residual():
    selection = select_effects(make_tables(make_windows(), {"headwind": 0.05}), "headwind")
    off = selection.build_basis()
    after = selection.compute_residual(off)
    assert off.shape == (len(after), 1)
    np.testing.assert_allclose(off.T @ after, 0.0, atol=1e-9)
    assert after @ after < 0.7 * selection.base.residual @ selection.base.residual
    without = selection.build_basis(without=selection.effects[0])
    np.testing.assert_array_equal(selection.compute_residual(without), selection.base.residual)


def test_held_out_residual_uses_coefficients_of_other_folds():
    selection = select_effects(make_tables(make_windows(), {"headwind": 0.05}), "headwind")
    off = selection.build_basis()
    left = selection.compute_held_out_residual(off)
    fold = selection.clusters[0].assign_folds(0)[selection.clusters[0].code]
    for k in range(int(fold.max()) + 1):
        here = fold == k
        fitted = np.linalg.lstsq(off[~here], selection.base.residual[~here], rcond=None)[0]
        np.testing.assert_allclose(left[here], (selection.base.residual - off @ fitted)[here], atol=1e-9)
    nothing = selection.keep(()).build_basis()
    np.testing.assert_array_equal(selection.compute_held_out_residual(nothing), selection.base.residual)
