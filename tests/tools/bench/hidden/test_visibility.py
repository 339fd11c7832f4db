"""Visibility compares the true energy of a hidden effect with the best form of every other effect."""

from dataclasses import replace
from math import log

import numpy as np
import pytest

from socast.core.diagnose.candidates import build_candidates
from socast.core.diagnose.dataset import gather_windows
from socast.core.diagnose.projection import BaseProjection
from socast.core.fit.recipes import fit_to_windows
from socast.tools.bench.hidden.cases import Case
from socast.tools.bench.hidden.evaluation import RATIO, compare_with_rivals, compute_true_energy, measure_visibility
from socast.tools.simulator.settings import Hidden


def gather(source, *hidden):
    """Return a data set as visibility needs it."""
    case = Case(5, hidden)
    tables = source.tables(case)
    model = fit_to_windows(case.recipe, tables.rides, tables.windows)
    windows = gather_windows(tables.rides, tables.windows, model)
    energy = compute_true_energy(windows, tables.hidden)
    return case, BaseProjection(windows, model), build_candidates(windows, model), energy


def test_large_distinct_effect_is_visible_and_a_tiny_one_is_not(source):
    large = measure_visibility(*gather(source, Hidden("headwind", 0.06)))
    tiny = measure_visibility(*gather(source, Hidden("headwind", 0.0005)))
    assert large["visible"] is True
    assert large["ratios"][0] > 10.0 * log(RATIO)
    assert tiny["visible"] is False


def test_ratio_is_that_of_two_normal_likelihoods(source):
    case, base, candidates, energy = gather(source, Hidden("headwind", 0.06))
    rival = np.arange(len(candidates.variants)) == candidates.variants.index("humidity")
    alone = replace(candidates, columns=candidates.columns * rival, sign=np.zeros(len(rival), dtype=np.int64))
    falls, left = [], []
    for column in (energy, candidates.columns[:, rival]):
        off = base.project_out(column)
        rest = base.residual - off @ np.linalg.lstsq(off, base.residual, rcond=None)[0]
        falls.append(base.residual @ base.residual - rest @ rest)
        left.append(rest @ rest)
    noise = left[0] / (len(base.residual) - base.rank)
    assert compare_with_rivals(case, base, alone, energy, 0) == pytest.approx((falls[0] - falls[1]) / (2.0 * noise))


def test_same_energy_under_another_name_is_no_longer_visible(source):
    case, base, candidates, energy = gather(source, Hidden("headwind", 0.06))
    at = candidates.variants.index("snow")
    columns = candidates.columns.copy()
    columns[:, at] = energy[:, 0]
    twin = replace(candidates, columns=columns)
    assert compare_with_rivals(case, base, twin, energy, 0) == pytest.approx(0.0, abs=1e-6)


def test_each_of_two_effects_is_judged_beside_the_other(source):
    seen = measure_visibility(*gather(source, Hidden("headwind", 0.06), Hidden("snow", 0.0005)))
    assert seen["ratios"][0] > log(RATIO) > seen["ratios"][1]
    assert seen["visible"] is False
