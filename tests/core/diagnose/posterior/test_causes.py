"""Test the evidence of causes on synthetic windows in which one or two effects are hidden."""

import numpy as np
import pytest

from socast.core.diagnose.candidates import build_candidates
from socast.core.diagnose.posterior.causes import LEAST_LEFT, SelectedForm, compute_cause_evidence
from socast.core.diagnose.posterior.families import MOST_SIGMAS, build_families, standardise
from socast.core.diagnose.projection import BaseProjection
from tests.support.synthetic_windows import gather_with_model, keep_only, make_tables, make_windows

NAMES = ("cold_rolling", "headwind", "night_lights", "snow", "payload", "standby")


def weigh(shares, selected=()):
    """Return the families of candidates and the evidence of each cause of windows with hidden effects."""
    windows, model = gather_with_model(make_tables(make_windows(), shares, of_ride=0.002))
    base = BaseProjection(windows, model)
    candidates = keep_only(build_candidates(windows, model), *NAMES)
    return build_families(base, candidates), compute_cause_evidence(base, candidates, selected)


@pytest.fixture(scope="module")
def one():
    return weigh({"headwind": 0.04})


@pytest.fixture(scope="module")
def two():
    return weigh({"headwind": 0.04, "night_lights": 0.04})


def test_hidden_effect_has_the_largest_evidence(one):
    _, evidence = one
    assert max(evidence.single, key=lambda name: evidence.single[name]) == "headwind"
    assert evidence.single["headwind"] > 10.0
    assert evidence.forms["headwind"].variant.startswith("headwind")


def test_effect_that_the_model_holds_has_no_evidence(one):
    families, evidence = one
    at = families.variants.index("standby")
    assert families.left[at] < LEAST_LEFT
    assert evidence.single.get("standby", -np.inf) == -np.inf


def test_best_pair_holds_both_effects(two):
    _, evidence = two
    best = max(evidence.pairs, key=lambda pair: evidence.pairs[pair])
    assert set(best) == {"headwind", "night_lights"}
    assert evidence.pairs[best] > max(evidence.single.values()) + 10.0


def test_selected_effect_leaves_the_evidence_of_the_other_one(two):
    _, both = two
    form = both.forms["headwind"]
    _, evidence = weigh({"headwind": 0.04, "night_lights": 0.04}, [SelectedForm(form.variant, form.coefficient)])
    assert "headwind" not in evidence.single
    assert max(evidence.single, key=lambda name: evidence.single[name]) == "night_lights"


def test_bends_have_no_mean_and_are_bounded():
    rng = np.random.default_rng(0)
    weight = rng.uniform(0.0, 1.0, 500)
    values = standardise(rng.standard_t(2.0, 500), weight)
    assert np.abs(values).max() <= MOST_SIGMAS
    assert not standardise(np.full(500, 3.0), weight).any()
    plain = standardise(rng.uniform(size=500), weight)
    assert weight @ plain == pytest.approx(0.0, abs=1e-9)
    assert weight @ plain**2 / weight.sum() == pytest.approx(1.0)
