"""Test the probabilities of causes: sums, order, and what makes an unknown cause more probable."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from socast.core.diagnose.posterior.causes import CauseEvidence, SelectedForm
from socast.core.diagnose.posterior.probabilities import NONE, SEVERAL, UNKNOWN, compute_probabilities

SINGLE = {"snow": 40.0, "cold_rolling": 25.0, "payload": 1.0}


def make(single=SINGLE, *, gain=0.0, unknown=0.0, beside=0.0, stiff=0.0):
    """Return evidence; a second effect adds `gain`, and the best effect has `stiff` less without bends."""
    best = max(single, key=lambda name: single[name])
    other = next(name for name in single if name != best)
    return CauseEvidence(
        single=dict(single),
        forms={name: SelectedForm(name, 1.0) for name in single},
        pairs={(best, other): single[best] + gain},
        stiff={name: value - stiff for name, value in single.items()},
        unknown=unknown,
        beside={best: beside},
    )


evidences = st.builds(
    make,
    st.dictionaries(st.sampled_from(["snow", "payload", "age", "headwind"]), st.floats(-5.0, 800.0), min_size=2),
    gain=st.floats(-3.0, 400.0),
    unknown=st.floats(-5.0, 800.0),
    beside=st.floats(-5.0, 400.0),
    stiff=st.floats(-5.0, 400.0),
)


@given(evidence=evidences)
def test_probabilities_sum_to_one_in_falling_order(evidence):
    causes = compute_probabilities(evidence)
    for values in (causes.probabilities, causes.leading):
        assert sum(values.values()) == pytest.approx(1.0)
        assert all(0.0 <= value <= 1.0 for value in values.values())
        assert list(values.values()) == sorted(values.values(), reverse=True)
    assert SEVERAL not in causes.leading


@given(evidence=evidences)
def test_credible_set_is_the_smallest_that_reaches_its_level(evidence):
    causes = compute_probabilities(evidence)
    kept = causes.list_credible_set(0.9)
    chance = [causes.leading[name] for name in kept]
    assert sum(chance) >= 0.9 - 1e-9
    assert sum(chance[:-1]) < 0.9


def test_strong_lone_effect_leads():
    causes = compute_probabilities(make())
    assert causes.first == "snow"
    assert causes.leading["snow"] > 0.9


def test_no_effect_leads_without_evidence():
    causes = compute_probabilities(make({"snow": -1.0, "payload": -2.0}))
    assert causes.first == NONE


def test_effects_keep_the_order_of_their_evidence():
    p = compute_probabilities(make()).probabilities
    assert p["snow"] > p["cold_rolling"] > p["payload"]


@pytest.mark.parametrize("what", [{"beside": 30.0}, {"stiff": 35.0}, {"unknown": 80.0, "beside": 45.0}])
def test_misfit_of_the_best_effect_points_beyond_the_library(what):
    plain, poor = (compute_probabilities(make(**each)).probabilities[UNKNOWN] for each in ({}, what))
    assert poor > 3.0 * plain


def test_gain_of_a_second_effect_points_to_several():
    one, two = (compute_probabilities(make(gain=gain)) for gain in (0.0, 60.0))
    assert two.probabilities[SEVERAL] > 0.5 > one.probabilities[SEVERAL]
    assert two.first == "snow"


def test_effect_that_cannot_be_identified_has_no_probability():
    evidence = make()
    causes = compute_probabilities(replace(evidence, single=evidence.single | {"age": -np.inf}))
    assert "age" not in causes.probabilities


def test_no_identifiable_effect_leaves_no_cause():
    evidence = replace(make(), single={"age": -np.inf}, pairs={})
    assert compute_probabilities(evidence).probabilities == {NONE: 1.0}
