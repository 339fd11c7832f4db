"""The search: what was planted is named, beside decoys that are not; stand-ins go again; what is alike is one group."""

from dataclasses import replace

import numpy as np
import pytest

from core.diagnose.candidates import Candidates, build_candidates
from core.diagnose.evidence import ClusterSums
from core.diagnose.forward_selection import ForwardSelection, SelectedEffect, SelectionSettings
from core.diagnose.projection import BaseProjection
from tests.support.synthetic_windows import (
    compute_coefficients,
    gather_with_model,
    keep_only,
    make_tables,
    make_windows,
)

LEAST_GAIN = 0.002


def search(shares, *names, most=6, least_gain=LEAST_GAIN, seed=1, twin=0.0, **errors) -> ForwardSelection:
    """Return a search that has not begun; `twin` adds a candidate that is the first with so much of another one."""
    windows, model = gather_with_model(make_tables(make_windows(), shares, seed=seed, **({"of_day": 0.02} | errors)))
    base, asked = BaseProjection(windows, model), build_candidates(windows, model)
    asked = keep_only(asked, *names) if names else asked
    clusters = [ClusterSums(base.windows.day), ClusterSums(base.windows.date)]
    return ForwardSelection(
        base, with_twin(asked, twin) if twin else asked, clusters, SelectionSettings(least_gain, most, 0)
    )


def with_twin(asked: Candidates, other: float) -> Candidates:
    first, size = asked.columns[:, 0], np.std(asked.columns[:, 0])
    twin = first + other * size * np.random.default_rng(3).normal(size=len(first))
    return replace(
        asked,
        variants=(*asked.variants, "twin"),
        effects=np.r_[asked.effects, len(asked.names)],
        names=(*asked.names, "twin"),
        sign=np.r_[asked.sign, asked.sign[0]],
        columns=np.column_stack([asked.columns, twin]),
    )


def named(search: ForwardSelection) -> set[str]:
    return {each.effect for each in search.selected}


@pytest.mark.parametrize(
    "effect", ["cold_rolling", "headwind", "wet_road", "night_lights", "regen_full_battery", "cornering"]
)
def test_planted_effect_is_selected_without_decoys(effect):
    found = search({effect: 0.06})
    found.select_all()
    assert named(found) == {effect}
    (finding,) = found.list_missing_effects()
    low, high = finding.evidence.compute_interval(0, 0.999)
    if "@" not in finding.selected.variant:
        assert low < compute_coefficients(make_windows(), {effect: 0.06})[effect] < high
    assert finding.gain > LEAST_GAIN
    assert finding.gain > 2.0 * finding.gain_error
    assert finding.selected.q < 0.01


@pytest.mark.parametrize("seed", range(4))
def test_nothing_is_selected_without_planted_effect(seed):
    found = search({}, seed=seed, of_day=0.03, of_ride=0.003)
    found.select_all()
    assert found.selected == found.list_missing_effects() == []


@pytest.mark.parametrize(
    "pair", [("headwind", "cold_rolling"), ("wet_road", "night_lights"), ("regen_full_battery", "cornering")]
)
def test_two_planted_effects_are_selected_or_grouped_by_gain(pair):
    found = search(dict.fromkeys(pair, 0.05), of_day=0.01)
    found.select_all()
    findings = found.list_missing_effects()
    groups = [{each.selected.effect, *(name for name, _ in each.rivals)} for each in findings]
    assert len(findings) == 2
    assert all(any(effect in group for group in groups) for effect in pair)
    assert sum(len(group) for group in groups) <= 3
    assert findings[0].gain >= findings[1].gain


def test_proxy_is_dropped_when_its_cause_is_selected():
    found = search({"cold_rolling": 0.08}, "cold_rolling", "air_density", "headwind")
    at = found.candidates.variants.index
    found.select(SelectedEffect(found.candidates, at("air_density"), 0.0))
    assert named(found) == {"air_density"}
    found.select(SelectedEffect(found.candidates, at("cold_rolling"), 0.0))
    assert named(found) == {"cold_rolling"}
    assert not found.is_new(SelectedEffect(found.candidates, at("air_density"), 0.0))
    assert found.is_new(SelectedEffect(found.candidates, at("headwind"), 0.0))
    found.select_all()
    assert named(found) == {"cold_rolling"}


def test_significant_effect_stays_beside_another():
    found = search({"cold_rolling": 0.06, "headwind": 0.05}, "cold_rolling", "headwind")
    for variant in ("headwind", "cold_rolling"):
        found.select(SelectedEffect(found.candidates, found.candidates.variants.index(variant), 0.0))
    assert named(found) == {"cold_rolling", "headwind"}
    assert not found.dropped


@pytest.mark.parametrize("effect", ["night_lights", "headwind"])
def test_nearly_identical_effects_form_one_group(effect):
    found = search({effect: 0.06}, effect, "cold_rolling", "wet_road", twin=0.02)
    found.select_all()
    assert len(found.selected) == 1
    (finding,) = found.list_missing_effects()
    assert {finding.selected.effect, *(name for name, _ in finding.rivals)} == {effect, "twin"}
    assert finding.rivals[0][1] > 0.95


def test_moderately_correlated_effects_are_distinguished():
    found = search({"night_lights": 0.08}, "night_lights", "cold_rolling", twin=0.5)
    found.select_all()
    (finding,) = found.list_missing_effects()
    assert finding.selected.effect == "night_lights"
    assert finding.rivals == []


class TestInexactRivals:
    """What rests on forces may be the cause although it explains less, as it is known less exactly."""

    def rivals(self, true: float, blur: float) -> set[str]:
        found = search({"cold_rolling": 0.08}, "cold_rolling", "cold_regen_limit")
        first = np.flatnonzero(found.candidates.effects == 0)
        column = found.candidates.columns[:, first[0]]
        noise = np.random.default_rng(5).normal(size=len(column)) * np.std(column)
        made = np.where((found.candidates.effects == 1)[np.newaxis], (true * column + blur * noise)[:, np.newaxis], 0.0)
        columns = np.where(found.candidates.effects == 1, made, found.candidates.columns)
        found.candidates = replace(found.candidates, columns=columns)
        found.select_all()
        (finding,) = found.list_missing_effects()
        assert finding.selected.effect == "cold_rolling"
        return {name for name, _ in finding.rivals}

    def test_noisy_copy_belongs_to_group(self):
        assert self.rivals(1.0, 0.3) == {"cold_regen_limit"}

    def test_dissimilar_rival_does_not_belong_to_group(self):
        assert self.rivals(0.2, 1.0) == set()


def test_selection_respects_maximum_number_and_least_gain():
    few, dear = (
        search({"headwind": 0.05, "cold_rolling": 0.06}, **limit) for limit in ({"most": 1}, {"least_gain": 0.99})
    )
    few.select_all()
    dear.select_all()
    assert len(few.selected) == 1
    assert dear.selected == []


def test_effect_is_selected_once():
    found = search({"cold_rolling@reference=283.15": 0.08}, "cold_rolling")
    found.select_all()
    assert len(found.selected) == 1
    again = SelectedEffect(found.candidates, found.candidates.variants.index("cold_rolling@reference=298.15"), 0.0)
    assert not found.is_new(again)
    elsewhere = found.candidates.restrict_to(found.base.windows.vehicle == 0, ("vehicle=taxi-0",))
    assert found.is_new(SelectedEffect(elsewhere, 0, 0.0))


def test_selected_effects_are_projected_off_residual():
    found = search({"headwind": 0.05}, "headwind")
    before = found.compute_residual(found.build_basis())
    np.testing.assert_array_equal(before, found.base.residual)
    found.select_all()
    off = found.build_basis()
    after = found.compute_residual(off)
    assert off.shape == (len(before), 1)
    np.testing.assert_allclose(off.T @ after, 0.0, atol=1e-9)
    before = found.base.residual  # weights are found anew beside what is named
    assert after @ after < 0.7 * before @ before
    np.testing.assert_array_equal(
        found.compute_residual(found.build_basis(without=found.selected[0])), found.base.residual
    )


def test_held_out_residual_uses_coefficients_of_other_folds():
    found = search({"headwind": 0.05}, "headwind")
    np.testing.assert_array_equal(found.compute_held_out_residual(found.build_basis()), found.base.residual)
    found.select_all()
    off = found.build_basis()
    left = found.compute_held_out_residual(off)
    fold = found.clusters[0].assign_folds(0)[found.clusters[0].code]
    for k in range(int(fold.max()) + 1):
        here = fold == k
        fitted = np.linalg.lstsq(off[~here], found.base.residual[~here], rcond=None)[0]
        np.testing.assert_allclose(left[here], (found.base.residual - off @ fitted)[here], atol=1e-9)
    assert left @ left > found.compute_residual(off) @ found.compute_residual(off)


def test_selection_is_reproducible():
    findings = []
    for _ in range(2):
        found = search({"cold_rolling": 0.05, "headwind": 0.05})
        found.select_all()
        findings.append(
            [
                (each.selected.variant, each.gain, each.evidence.p[0], each.rivals)
                for each in found.list_missing_effects()
            ]
        )
    assert findings[0] == findings[1]
