"""Test the base beside which cars are tested: columns without energy take nothing."""

import numpy as np
import pytest

from socast.core.diagnose.candidates import build_candidates
from socast.core.diagnose.projection import BaseProjection
from socast.core.diagnose.siblings.deviations import keep_declared_values
from socast.core.diagnose.siblings.spread import SiblingBase
from socast.core.diagnose.siblings.sums import gather_siblings
from tests.support.synthetic_windows import gather_with_model, make_tables, make_windows


@pytest.mark.filterwarnings("error")
def test_effect_found_elsewhere_changes_no_test_of_a_model_that_lacks_it():
    """A deviation of all cars is a column of the base also of a model whose cars never meet its cause."""
    windows, model = gather_with_model(make_tables(make_windows(4), {}, of_day=0.01))
    candidates = keep_declared_values(build_candidates(windows, model, scopes=True))
    (siblings,) = gather_siblings(BaseProjection(windows, model), candidates, np.empty((len(windows.measured), 0)))
    variance = np.ones(siblings.direction.shape[1])
    without = SiblingBase(siblings, variance).score_shifts(0)
    beside = SiblingBase(siblings.add_fixed(0, np.zeros(len(siblings.start))), variance).score_shifts(0)
    assert beside.score == pytest.approx(without.score)
    weights = np.ones((1, len(without.score)))
    assert beside.project(weights).information == pytest.approx(without.project(weights).information)
