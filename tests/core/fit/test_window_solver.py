"""Test that the solver takes no step that makes the fit worse, converges, and ignores the last digits of its input."""

from dataclasses import replace

import numpy as np
import pytest

from socast.core.batch import Floats
from socast.core.fit import window_solver
from socast.core.fit.accessory_curve import build_curve, flatten_curve
from socast.core.fit.block_sums import limit_to_one_thread
from socast.core.fit.measured_rows import join_tables
from socast.core.fit.nested_effects import SMALL_STEP
from socast.core.fit.recipes import get_recipe
from socast.core.fit.window_fit import gather_rows
from socast.core.fit.window_solver import (
    INDEPENDENT,
    GroupFit,
    GroupRows,
    Problem,
    State,
    move,
    shift_prior,
    solve_group,
    sum_windows,
)
from socast.core.vehicles import ACCESSORIES
from tests.support.synthetic_windows import make_tables, make_windows


@pytest.fixture(scope="module")
def group() -> GroupRows:
    rows = join_tables(*make_tables(make_windows(3, 12, 3, 6), noise=0.003))
    rows = rows.sort_values(["vehicle_id", "date", "ride_key"], kind="stable", ignore_index=True)
    return gather_rows(get_recipe("road_load").terms, rows, {})


@pytest.fixture(scope="module")
def fitted(group) -> GroupFit:
    with limit_to_one_thread():
        return solve_group(group)


def get_numbers(group: GroupRows, found: GroupFit) -> Floats:
    return np.concatenate([found.posterior.mean[: group.terms], flatten_curve(found.curve)])


def make_problem(group: GroupRows, state: State) -> Problem:
    return Problem(group, sum_windows(group, np.full(len(group.columns), 1e4)), INDEPENDENT, state)


def start(group: GroupRows, *step: float) -> State:
    numbers = flatten_curve(ACCESSORIES) + np.array(step or [0.0] * 7)
    return State(group.prior.mean[: group.terms], build_curve(numbers))


@pytest.mark.parametrize("seed", range(5))
def test_last_digits_of_the_input_change_nothing(group, fitted, seed):
    noise = np.random.default_rng(seed).uniform(-1.0, 1.0, group.columns.shape)
    with limit_to_one_thread():
        other = solve_group(replace(group, columns=group.columns * (1.0 + 1e-14 * noise)))
    np.testing.assert_allclose(get_numbers(group, other), get_numbers(group, fitted), rtol=1e-7)


def test_fit_converges_to_a_maximum(group, fitted):
    assert fitted.converged
    state = State(fitted.posterior.mean[: group.terms], fitted.curve)
    problem = make_problem(group, state)
    best, converged = window_solver._descend(problem, state, SMALL_STEP)
    assert converged
    loss = problem.linearise(best).loss
    sd = np.sqrt(np.diag(group.prior.covariance))
    for i in range(len(sd)):
        for sign in (1.0, -1.0):
            moved = move(group, best, np.where(np.arange(len(sd)) == i, sign * 1e-3 * sd, 0.0))
            assert problem.linearise(moved).loss >= loss, i


def test_derivatives_of_the_density_are_exact(group):
    state = start(group)
    problem = make_problem(group, state)
    here, p = problem.linearise(state), len(group.prior.mean)
    precision = np.linalg.inv(group.prior.covariance)
    x = np.r_[state.coefficients, np.zeros(p - group.terms)]
    slope = here.total[:p, :p] @ x - here.total[:p, p] + precision @ (x - shift_prior(group, state).mean)
    curvature = here.total[:p, :p] + here.bend + precision
    rng, sd = np.random.default_rng(2), np.sqrt(np.diag(group.prior.covariance))
    for _ in range(5):
        step = 1e-3 * sd * rng.normal(size=p)
        up, down = (problem.linearise(move(group, state, sign * step)).loss for sign in (1.0, -1.0))
        assert (up - down) / 4.0 == pytest.approx(slope @ step, rel=1e-3)
        assert (up + down - 2.0 * here.loss) / 2.0 == pytest.approx(step @ curvature @ step, rel=1e-2)


def test_step_that_raises_the_loss_is_shortened(group, monkeypatch):
    """A curve that hardly heats tells next to nothing of its choke points, so a whole step goes much too far."""
    state = start(group, 1100.0, -3400.0, 3400.0, -15.0, -8.0, 4.0, 6.0)
    problem = make_problem(group, state)
    solution, _ = window_solver._limited(group, state, window_solver._add_bend(group, problem.linearise(state)))
    whole = move(group, state, solution - np.r_[state.coefficients, np.zeros(7)])
    losses = []
    original = Problem.linearise

    def watch(self, at):
        found = original(self, at)
        losses.append(found.loss)
        return found

    assert problem.linearise(whole).loss > problem.linearise(state).loss
    monkeypatch.setattr(Problem, "linearise", watch)
    best, converged = window_solver._descend(problem, state, SMALL_STEP)
    assert converged
    assert original(problem, best).loss < losses[0] < losses[1]


def test_descent_without_a_better_step_is_marked(group, monkeypatch):
    monkeypatch.setattr(window_solver, "STEPS", 1)
    with limit_to_one_thread():
        assert not solve_group(group).converged
