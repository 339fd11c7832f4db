"""Test the figure of the probabilities of causes."""

import pytest

from socast.core.diagnose.records import CauseProbability
from socast.tools.report.diagnosis.figures import MOST, draw_causes
from tests.support.html_pages import assert_axes_are_titled

CAUSES = [
    CauseProbability(effect="none", probability=0.05),
    CauseProbability(effect="headwind", probability=0.6),
    CauseProbability(effect="crosswind_yaw", probability=0.35),
    CauseProbability(effect="unknown", probability=None),
]


def test_bars_are_sorted_with_effects_first():
    [one] = draw_causes(CAUSES)
    rows = [(name, share) for trace in one.figure.data for name, share in zip(trace.y, trace.x, strict=True)]
    assert [name for name, _ in rows] == ["headwind", "crosswind yaw", "no missing effect"]
    assert [share for _, share in rows] == pytest.approx([60.0, 35.0, 5.0])
    assert one.figure.data[0].text[0] == "60 %"
    assert_axes_are_titled(one.figure)


def test_a_cause_outside_the_library_is_no_effect_of_it():
    [one] = draw_causes([*CAUSES[:2], CauseProbability(effect="unknown", probability=0.35)])
    named, apart = one.figure.data
    assert list(named.y) == ["headwind"]
    assert list(apart.y) == ["a cause outside the library", "no missing effect"]


def test_many_causes_share_the_last_bar():
    [one] = draw_causes([CauseProbability(effect=f"cause {i}", probability=0.05) for i in range(20)])
    assert len(one.figure.data[0].y) == MOST
    assert one.figure.data[0].y[-1] == f"{20 - MOST + 1} others"
    assert sum(one.figure.data[0].x) == pytest.approx(100.0)


def test_improbable_effects_share_one_row():
    causes = [
        CauseProbability(effect="headwind", probability=0.95),
        *(CauseProbability(effect=f"cause {i}", probability=0.004) for i in range(10)),
        CauseProbability(effect="none", probability=0.01),
    ]
    [one] = draw_causes(causes)
    named, apart = one.figure.data
    assert list(named.y) == ["headwind", "10 others"]
    assert list(named.x) == pytest.approx([95.0, 4.0])
    assert list(apart.text) == ["1 %"]
    [small] = draw_causes(
        [*causes[:1], CauseProbability(effect="a", probability=1e-9), CauseProbability(effect="b", probability=1e-9)]
    )
    assert list(small.figure.data[0].text) == ["95 %", "< 0.5 %"]


def test_nothing_is_drawn_without_probabilities():
    assert draw_causes([]) == draw_causes([CauseProbability(effect="headwind", probability=None)]) == []
