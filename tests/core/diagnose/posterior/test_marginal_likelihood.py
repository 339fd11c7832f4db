"""Test the marginal likelihood of a family of shapes against direct integration of the normal densities."""

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from socast.core.diagnose.posterior.causes import make_log_prior
from socast.core.diagnose.posterior.marginal_likelihood import (
    LARGEST,
    SMALLEST,
    Products,
    compute_marginal_likelihood,
)

BEND = 0.25
N = 12


def draw(seed, coefficient=0.04):
    """Return a form, two bends and a residual with unit noise."""
    rng = np.random.default_rng(seed)
    form = 30.0 * rng.uniform(0.5, 2.0, N)
    bends = form[:, np.newaxis] * rng.normal(size=(N, 2))
    return form, bends, coefficient * (form + bends @ [0.2, -0.1]) + rng.normal(size=N)


def compute(form, bends, residual, sign=1, prior=None, bend=BEND):
    columns = np.column_stack([form, bends])
    products = Products(columns.T @ columns, columns.T @ residual)
    return compute_marginal_likelihood(products, 1.0, sign, prior or make_log_prior(1.0), bend)


def integrate(form, bends, residual, signs=(1,), bend=BEND):
    """Return the log evidence by a dense sum over coefficients, with the covariance of noise and bends written out."""
    values = np.exp(np.linspace(np.log(SMALLEST), np.log(LARGEST), 3000))
    prior = np.exp(make_log_prior(1.0)(values))
    nothing = multivariate_normal(np.zeros(N), np.eye(N)).logpdf(residual)
    total = 0.0
    for sign in signs:
        ratios = [
            np.exp(
                multivariate_normal(sign * v * form, np.eye(N) + (v * bend) ** 2 * bends @ bends.T).logpdf(residual)
                - nothing
            )
            for v in values
        ]
        total += np.trapezoid(np.array(ratios) * prior, np.log(values)) / len(signs)
    return np.log(total)


@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize("coefficient", [0.0, 0.01, 0.06])
def test_evidence_equals_direct_integration(seed, coefficient):
    data = draw(seed, coefficient)
    assert compute(*data).log_evidence == pytest.approx(integrate(*data), abs=0.02)


def test_either_sign_has_half_of_the_prior():
    data = draw(3)
    assert compute(*data, sign=0).log_evidence == pytest.approx(integrate(*data, signs=(1, -1)), abs=0.02)


def test_coefficient_is_near_the_truth():
    form, bends, residual = draw(4, 0.08)
    assert compute(form, bends, residual).coefficient == pytest.approx(0.08, abs=0.02)


def test_wrong_sign_is_less_probable_than_nothing():
    form, bends, residual = draw(5, 0.08)
    assert compute(form, bends, -residual).log_evidence < 0.0


def test_bends_explain_what_the_form_does_not():
    rng = np.random.default_rng(6)
    form = np.full(N, 30.0)
    bends = (form * np.linspace(-1.5, 1.5, N))[:, np.newaxis]
    residual = 0.08 * (form + 0.5 * bends[:, 0]) + 0.1 * rng.normal(size=N)
    assert compute(form, bends, residual).log_evidence > compute(form, bends, residual, bend=0.0).log_evidence + 3.0


def test_coefficient_beyond_the_plausible_range_is_less_probable():
    data = draw(7, 0.08)
    free, narrow = (compute(*data, prior=make_log_prior(1.0, limits)).log_evidence for limits in (None, (0.001, 0.01)))
    assert narrow < free - 3.0
    below = compute(*data, prior=make_log_prior(1.0, (0.2, 0.3))).log_evidence
    assert below == pytest.approx(free, abs=1e-9)


def test_form_without_size_is_absent():
    assert compute(np.zeros(N), np.zeros((N, 2)), np.ones(N)).log_evidence == -np.inf
