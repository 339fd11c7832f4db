"""What is planted in a small synthetic fleet is found with its size, its car and its date, and nothing else."""

from functools import cache

import numpy as np
import pytest

from tests.support.inferences import infer
from tests.support.synthetic_windows import compute_coefficients, make_tables, make_windows

pytestmark = pytest.mark.long

SINCE = "since=2018-05-17"
GROUPS = {"taxi-0": "north", "taxi-1": "south", "taxi-2": "south", "taxi-3": "north"}
CASES = {
    "nothing": {},
    "all": {"headwind": 0.015},
    "implausible": {"headwind": 0.06},
    "car": {f"roof_load vehicle=taxi-1 {SINCE}": 0.08},
    "group": {f"tyre_pressure vehicle=taxi-{car} {SINCE}": 0.08 for car in (1, 2)},
}
"""Shares of the energy of planted effects."""


@cache
def infer_case(name):
    """Return what the inference finds in one of the fleets."""
    tables = make_tables(make_windows(4, 14, 2, 6), CASES[name], of_day=0.01)
    *_, found = infer(tables, groups=GROUPS if name == "group" else None)
    return found


def get_likely(name):
    """Return the findings that are reported."""
    return [one for one in infer_case(name).findings if one.is_likely]


def test_nothing_is_found_where_nothing_is_planted():
    assert get_likely("nothing") == []
    assert max(infer_case("nothing").chances.values()) < 0.5
    assert [one.effect for one in infer_case("nothing").expected if one.is_likely] == []


@pytest.mark.parametrize(
    ("name", "effect", "of", "who", "kind"),
    [
        ("all", "headwind", "all", "headwind", "always"),
        ("car", "roof_load", "car", "taxi-1", "step"),
        ("group", "tyre_pressure", "group", "group south", "step"),
    ],
)
def test_planted_effect_is_found_where_it_is_and_nothing_else(name, effect, of, who, kind):
    (only,) = get_likely(name)
    assert (only.effect, only.family.of, only.family.who, only.when.kind) == (effect, of, who, kind)
    assert only.probability > 0.95
    assert only.evidence > 10.0


def test_implausible_size_is_no_name():
    (first, *_) = infer_case("implausible").findings
    assert (first.effect, first.is_supported, first.is_plausible, first.is_likely) == ("headwind", True, False, False)
    assert first.limits == (0.0, 1.6)
    assert first.size.estimate.interval[0] > 1.6


@pytest.mark.parametrize("name", ["all", "car", "group"])
def test_size_is_that_of_the_planted_effect(name):
    (only,) = get_likely(name)
    planted = np.mean(list(compute_coefficients(make_windows(4, 14, 2, 6), CASES[name]).values()))
    assert abs(only.size.estimate.value - planted) < 3.0 * only.size.estimate.error
    assert only.size.estimate.error < 0.3 * planted


@pytest.mark.parametrize("name", ["car", "group"])
def test_change_has_its_date(name):
    (only,) = get_likely(name)
    assert only.when.since == SINCE.removeprefix("since=")
    assert sum(only.dates.values()) == pytest.approx(1.0)
    assert only.dates[only.place] > 0.5


@pytest.mark.parametrize("name", ["all", "car", "group"])
def test_causes_share_the_probability_of_a_finding(name):
    (only,) = get_likely(name)
    assert sum(only.causes.values()) == pytest.approx(1.0)
    assert list(only.causes.values()) == sorted(only.causes.values(), reverse=True)
    assert next(iter(only.causes)) == only.effect


def test_energy_of_a_finding_acts_only_where_it_is():
    (only,) = get_likely("car")
    columns = infer_case("car").columns
    there = (columns.car_of_day == 1) & (columns.date_of_day >= columns.dates.index(only.when.since))
    assert set(np.flatnonzero(columns.sum_days(np.abs(only.column)))) == set(np.flatnonzero(there))


def test_every_effect_has_a_probability_or_is_expected_or_not_identified():
    found = infer_case("all")
    assert found.chances["headwind"] > 0.95
    assert found.alone["headwind"][0] == "headwind"
    assert found.alone["headwind"][1] > 10.0
    bases = {name.partition("@")[0] for name in found.columns.names}
    assert bases == {*found.chances, *(one.effect for one in found.expected)}
    assert found.unidentified <= set(found.chances)
