"""Test chances of evidence: they are uniform without a change, and small beside one."""

import numpy as np
import pytest

from socast.core.diagnose.candidates import build_candidates
from socast.core.diagnose.projection import BaseProjection
from socast.core.diagnose.siblings.chance import estimate_chance
from socast.core.diagnose.siblings.deviations import keep_declared_values
from socast.core.diagnose.siblings.scan import scan_changes
from socast.core.diagnose.siblings.spread import SiblingBase, estimate_spread_without
from socast.core.diagnose.siblings.sums import gather_siblings
from tests.support.synthetic_windows import gather_with_model, make_tables, make_windows


def score_first_car(shares):
    """Return the sums, the scores of the first car, the starts of its shifts, and the signs of the candidates."""
    windows, model = gather_with_model(make_tables(make_windows(4), shares, of_day=0.01))
    candidates = keep_declared_values(build_candidates(windows, model, scopes=True))
    groups = gather_siblings(BaseProjection(windows, model), candidates, np.empty((len(windows.measured), 0)))
    (siblings,) = groups
    scores = SiblingBase(siblings, estimate_spread_without(groups, 0, 0)).score_shifts(0)
    return siblings, scores, siblings.start[siblings.car == 0], candidates.sign


@pytest.fixture(scope="module")
def clean():
    return score_first_car({})


def compute_chance(siblings, scores, start, sign):
    scans = [scan_changes(siblings, scores, 0, kind) for kind in ("step", "ramp")]
    return estimate_chance(scores, start, scans, sign)


def test_chance_is_uniform_without_a_change(clean):
    """A chance below α is as frequent as α, also beyond the draws that are kept for the tail."""
    siblings, scores, start, sign = clean
    drawn = scores.draw(120, np.random.default_rng(2))
    chances = np.array([compute_chance(siblings, scores._replace(score=each), start, sign) for each in drawn])
    for level in (0.02, 0.05, 0.1):
        error = np.sqrt(level / len(chances))
        assert abs(np.mean(chances < level) - level) < 3.5 * error


def test_chance_of_a_planted_change_is_small():
    siblings, scores, start, sign = score_first_car({"roof_load vehicle=taxi-0 since=2018-06-05": 0.08})
    assert compute_chance(siblings, scores, start, sign) < 1e-4


def test_same_data_have_the_same_chance(clean):
    siblings, scores, start, sign = clean
    noisy = scores._replace(score=1.3 * scores.draw(1, np.random.default_rng(3))[0])
    assert compute_chance(siblings, noisy, start, sign) == compute_chance(siblings, noisy, start, sign)
