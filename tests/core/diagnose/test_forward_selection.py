"""Test forward selection: planted effects are selected without decoys, proxies dropped, twins share a probability."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from socast.core import effects
from socast.core.diagnose.candidates import Candidates, build_candidates
from socast.core.diagnose.forward_selection import ForwardSelection, SelectedEffect, SelectionSettings
from socast.core.diagnose.posterior.probabilities import SEVERAL, Causes
from socast.core.diagnose.projection import BaseProjection
from socast.core.stats.evidence import ClusterSums
from socast.core.stats.scores import compute_half_widths
from tests.support.synthetic_windows import (
    compute_coefficients,
    gather_with_model,
    keep_only,
    make_tables,
    make_windows,
)

pytestmark = pytest.mark.long

LEAST_GAIN = 0.002


@cache
def project(shares, seed, **errors) -> tuple[BaseProjection, Candidates]:
    """Return the projection of windows with planted effects, and the candidates."""
    made = make_tables(make_windows(), dict(shares), seed=seed, **({"of_day": 0.02} | errors))
    windows, model = gather_with_model(made)
    return BaseProjection(windows, model), build_candidates(windows, model)


def search(shares, *names, most=6, least_gain=LEAST_GAIN, seed=1, twin=0.0, **errors) -> ForwardSelection:
    """Return a selection before its first step; `twin` adds a copy of the first candidate with this share of noise."""
    base, candidates = project(tuple(sorted(shares.items())), seed, **errors)
    candidates = keep_only(candidates, *names) if names else candidates
    clusters = [ClusterSums(base.windows.day), ClusterSums(base.windows.date)]
    return ForwardSelection(
        base, with_twin(candidates, twin) if twin else candidates, clusters, SelectionSettings(least_gain, most, 0)
    )


def with_twin(candidates: Candidates, other: float) -> Candidates:
    first, size = candidates.columns[:, 0], np.std(candidates.columns[:, 0])
    twin = first + other * size * np.random.default_rng(3).normal(size=len(first))
    return replace(
        candidates,
        variants=(*candidates.variants, "twin"),
        effects=np.r_[candidates.effects, len(candidates.names)],
        names=(*candidates.names, "twin"),
        sign=np.r_[candidates.sign, candidates.sign[0]],
        columns=np.column_stack([candidates.columns, twin]),
    )


def named(search: ForwardSelection) -> set[str]:
    return {each.effect for each in search.selected}


@pytest.mark.parametrize(
    "effect", ["cold_rolling", "headwind", "wet_road", "night_lights", "regen_full_battery", "cornering"]
)
def test_planted_effect_is_selected_without_decoys(effect):
    selection = search({effect: 0.06})
    selection.select_all()
    assert named(selection) == {effect}
    (finding,) = selection.list_missing_effects()
    found = finding.evidence.get_estimate(0)
    half = compute_half_widths(found.error, found.freedom, 0.999)
    if "@" not in finding.selected.variant:
        assert abs(compute_coefficients(make_windows(), {effect: 0.06})[effect] - found.value) < half
    assert finding.gain.value > LEAST_GAIN
    assert finding.gain.value > finding.gain.ci95
    assert finding.selected.probability > 0.7


@pytest.mark.parametrize("seed", range(4))
def test_nothing_is_selected_without_planted_effect(seed):
    selection = search({}, seed=seed, of_day=0.03, of_ride=0.003)
    selection.select_all()
    assert selection.selected == selection.list_missing_effects() == []


PAIRS = (("headwind", "cold_rolling"), ("wet_road", "night_lights"), ("regen_full_battery", "cornering"))


@cache
def select_pair(*pair: str) -> tuple[ForwardSelection, Causes]:
    """Return a selection after its last step, and the causes of what it leaves."""
    selection = search(dict.fromkeys(pair, 0.05), of_day=0.01)
    return selection, selection.select_all()


@pytest.mark.parametrize("pair", PAIRS)
def test_two_planted_effects_are_selected_one_after_the_other(pair):
    selection, causes = select_pair(*pair)
    assert [each.selected.effect for each in selection.list_missing_effects()] == [
        each.effect for each in selection.selected
    ]
    assert named(selection) == set(pair)
    assert causes.probabilities[SEVERAL] > 0.3


def test_proxy_is_dropped_when_its_cause_is_selected():
    selection = search({"cold_rolling": 0.08}, "cold_rolling", "air_density", "headwind")
    at = selection.candidates.variants.index
    selection.select(SelectedEffect(selection.candidates, at("air_density"), 0.0))
    assert named(selection) == {"air_density"}
    selection.select(SelectedEffect(selection.candidates, at("cold_rolling"), 0.0))
    assert named(selection) == {"cold_rolling"}
    assert not selection.is_new(SelectedEffect(selection.candidates, at("air_density"), 0.0))
    assert selection.is_new(SelectedEffect(selection.candidates, at("headwind"), 0.0))
    selection.select_all()
    assert named(selection) == {"cold_rolling"}


def test_significant_effect_stays_beside_another():
    selection = search({"cold_rolling": 0.06, "headwind": 0.05}, "cold_rolling", "headwind")
    for variant in ("headwind", "cold_rolling"):
        selection.select(SelectedEffect(selection.candidates, selection.candidates.variants.index(variant), 0.0))
    assert named(selection) == {"cold_rolling", "headwind"}
    assert not selection.dropped


@pytest.mark.parametrize("effect", ["cornering", "headwind"])
def test_nearly_identical_effects_share_the_probability(effect):
    selection = search({effect: 0.06}, effect, "cold_rolling", "wet_road", twin=0.002)
    selection.select_all()
    (selected,) = selection.selected
    assert {effect, "twin"} <= set(selected.causes.list_credible_set())
    assert selected.probability < 0.9
    credible = selected.causes.list_credible_set()
    (pair,) = [each for each in selection.correlate(selected, credible) if each[0] in {effect, "twin"}]
    assert pair[1] > 0.95


def test_moderately_correlated_effects_are_distinguished():
    selection = search({"night_lights": 0.08}, "night_lights", "cold_rolling", twin=0.5)
    selection.select_all()
    (selected,) = selection.selected
    assert selected.effect == "night_lights"
    assert "twin" not in selected.causes.list_credible_set()


def test_gain_of_an_implausible_coefficient_is_that_of_the_largest_plausible_one():
    selection = search({}, "cabin_heating")
    column = selection.base.project_out(selection.candidates.columns)[:, 0]
    low, high = selection.candidates.get_limits(0)
    assert (low, high) == (0.0, effects.get("cabin_heating").high)
    residual = 2.0 * high * column
    capped = selection.compute_gain(column, residual, (low, high))
    assert capped.value == pytest.approx(1.0 - 0.5**2)
    assert selection.compute_gain(column, residual, (low, 3.0 * high)).value == pytest.approx(1.0)
    assert selection.compute_gain(column, -residual, (low, high)).value == 0.0


def test_selection_respects_maximum_number_and_least_gain():
    few, dear = (
        search({"headwind": 0.05, "cold_rolling": 0.06}, **limit) for limit in ({"most": 1}, {"least_gain": 0.99})
    )
    few.select_all()
    dear.select_all()
    assert len(few.selected) == 1
    assert dear.selected == []


def test_effect_is_selected_once():
    selection = search({"cold_rolling@reference=283.15": 0.08}, "cold_rolling")
    selection.select_all()
    assert len(selection.selected) == 1
    again = SelectedEffect(
        selection.candidates, selection.candidates.variants.index("cold_rolling@reference=298.15"), 0.0
    )
    assert not selection.is_new(again)
    elsewhere = selection.candidates.restrict_to(selection.base.windows.vehicle == 0, ("vehicle=taxi-0",))
    assert selection.is_new(SelectedEffect(elsewhere, 0, 0.0))


def test_selected_effects_are_projected_off_residual():
    selection = search({"headwind": 0.05}, "headwind")
    before = selection.compute_residual(selection.build_basis())
    np.testing.assert_array_equal(before, selection.base.residual)
    selection.select_all()
    off = selection.build_basis()
    after = selection.compute_residual(off)
    assert off.shape == (len(before), 1)
    np.testing.assert_allclose(off.T @ after, 0.0, atol=1e-9)
    before = selection.base.residual  # weights are found anew beside what is named
    assert after @ after < 0.7 * before @ before
    np.testing.assert_array_equal(
        selection.compute_residual(selection.build_basis(without=selection.selected[0])), selection.base.residual
    )


def test_held_out_residual_uses_coefficients_of_other_folds():
    selection = search({"headwind": 0.05}, "headwind")
    np.testing.assert_array_equal(selection.compute_held_out_residual(selection.build_basis()), selection.base.residual)
    selection.select_all()
    off = selection.build_basis()
    left = selection.compute_held_out_residual(off)
    fold = selection.clusters[0].assign_folds(0)[selection.clusters[0].code]
    for k in range(int(fold.max()) + 1):
        here = fold == k
        fitted = np.linalg.lstsq(off[~here], selection.base.residual[~here], rcond=None)[0]
        np.testing.assert_allclose(left[here], (selection.base.residual - off @ fitted)[here], atol=1e-9)
    assert left @ left > selection.compute_residual(off) @ selection.compute_residual(off)


def test_selection_is_reproducible():
    first, _ = select_pair(*PAIRS[0])
    project.cache_clear()
    again, _ = select_pair.__wrapped__(*PAIRS[0])
    first, again = (
        [
            (each.selected.variant, each.gain, each.evidence.p[0], each.selected.probability)
            for each in selection.list_missing_effects()
        ]
        for selection in (first, again)
    )
    assert len(first) == len(PAIRS[0])
    assert first == again
