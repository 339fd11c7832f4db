"""Test refitting a model with one more effect: the other terms are fitted in the way in which they were before."""

import numpy as np
import pytest

from socast.core.diagnose.add.add import add_effect
from socast.core.diagnose.add.terms import build_term_columns
from socast.core.fit.measured_rows import join_tables
from socast.core.fit.recipes import fit_to_windows
from socast.core.fit.window_fit import fit_rows
from socast.core.models import ANY
from socast.core.models.features import Columns
from tests.support.planted_windows import planted

COLD = 1e-4
"""Planted coefficient of cold rolling. [1/K]"""


@pytest.fixture(scope="module")
def tables():
    return planted({"effect_cold_rolling": COLD}, vehicles=2, days=10)


@pytest.fixture(scope="module")
def added(tables):
    model = fit_to_windows("road_load_constant", *tables)
    rows = join_tables(*tables)
    return add_effect(model, "cold_rolling", build_term_columns("cold_rolling"), rows, rides=tables[0]).model


def test_model_of_windows_keeps_its_priors(tables, added):
    rows = join_tables(*tables)
    *terms, effect = added.terms
    energy = added.fits[ANY].coefficients[-1] * Columns(rows)[effect.columns[0]]
    alone, _ = fit_rows("road_load_constant", tuple(terms), rows.assign(energy_kwh=rows["energy_kwh"] - energy))
    np.testing.assert_allclose(added.fits[ANY].coefficients[:-1], alone.fits[ANY].coefficients, rtol=1e-9)
