"""Baselines name a large effect first, and rank only effects of the library."""

from dataclasses import replace

import numpy as np
import pytest

from socast.core.diagnose.candidates import build_candidates
from socast.core.diagnose.dataset import gather_windows
from socast.core.diagnose.projection import BaseProjection
from socast.core.fit.recipes import fit_to_windows
from socast.tools.bench.hidden.baselines import (
    BASELINES,
    DESCRIPTIONS,
    LONGEST,
    RANKED,
    project_candidates,
    rank_by_baselines,
    rank_by_size,
)
from socast.tools.bench.hidden.cases import Case
from socast.tools.simulator.settings import Hidden


@pytest.fixture(scope="module")
def problem(source):
    case = Case(5, (Hidden("headwind", 0.15),))
    tables = source.tables(case)
    model = fit_to_windows(case.recipe, tables.rides, tables.windows)
    windows = gather_windows(tables.rides, tables.windows, model)
    return BaseProjection(windows, model), build_candidates(windows, model)


@pytest.fixture(scope="module")
def rankings(problem):
    """Return the effects as each baseline ranks them."""
    return rank_by_baselines(*problem)


@pytest.mark.parametrize("method", BASELINES)
def test_large_effect_is_first(rankings, method):
    if method == "pysindy":
        pytest.importorskip("pysindy")
    assert rankings[method][0] == "headwind"


def test_rankings_hold_few_effects_and_are_the_same_every_time(problem, rankings):
    assert rankings == rank_by_baselines(*problem)
    assert set(rankings) <= set(BASELINES) == set(DESCRIPTIONS) - {RANKED}
    assert all(len(names) <= LONGEST and set(names) <= set(problem[1].names) for names in rankings.values())


def test_effect_that_the_model_explains_has_no_column(problem):
    base, candidates = problem
    columns = candidates.columns.copy()
    columns[:, -1] = base.windows.table["duration_s"]
    off = project_candidates(base, replace(candidates, columns=columns))
    assert not off[:, -1].any()
    assert off[:, candidates.variants.index("headwind")].any()


def test_effect_has_the_size_of_its_largest_variant(problem):
    candidates = problem[1]
    size = np.zeros(len(candidates.variants))
    size[[0, -1]] = 1.0, 2.0
    assert rank_by_size(candidates, size) == [candidates.names[candidates.effects[at]] for at in (-1, 0)]
