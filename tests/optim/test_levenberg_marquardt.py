"""The Levenberg-Marquardt loop on small problems with known minima."""

import math
from itertools import pairwise

import pytest
import torch

from torchrefrac.optim import LevenbergMarquardtOptions, Step, minimize

START = torch.tensor([-1.2, 1.0], dtype=torch.float64)
EXACT = LevenbergMarquardtOptions(function_tolerance=1e-14)


class Rosenbrock:
    """Half the squares of 10 (y - x^2) and 1 - x: the minimum is 0 at (1, 1). Remembers every damping, and the costs
    wherever it was linearised."""

    def __init__(self):
        self.dampings, self.asked = [], []

    def residual(self, state):
        x, y = state
        return torch.stack((10.0 * (y - x * x), 1.0 - x))

    def cost(self, state):
        return 0.5 * self.residual(state).square().sum()

    def linearize(self, state, near=False):
        cost = self.cost(state)
        self.asked.append(float(cost))
        jacobian = torch.autograd.functional.jacobian(self.residual, state)
        return _Dense(self, cost, jacobian, self.residual(state))

    def retract(self, state, step):
        return state + step.reduced


class _Dense:
    def __init__(self, problem, cost, jacobian, residual):
        self.problem, self.cost = problem, cost
        self.hessian, self.gradient = jacobian.T @ jacobian, jacobian.T @ residual

    def solve(self, damping):
        self.problem.dampings.append(damping)
        x = torch.linalg.solve(self.hessian + damping * torch.diag(self.hessian.diagonal()), -self.gradient)
        decrease = -(self.gradient @ x) - 0.5 * (x @ self.hessian @ x)
        return Step(x, torch.zeros(0, 3), decrease, torch.tensor(True))


class Line(Rosenbrock):
    """A linear problem: one undamped step reaches the minimum, 2 at (3, -1)."""

    def residual(self, state):
        x, y = state
        return torch.stack((x - 3.0, 2.0 * (y + 1.0), x - 3.0, torch.full_like(x, 2.0)))


class Uphill(Rosenbrock):
    """Steps that promise much and always go up."""

    def retract(self, state, step):
        return state - step.reduced


class Cliff(Rosenbrock):
    """The cost is no number wherever x > 0."""

    def cost(self, state):
        return super().cost(state) * (math.nan if state[0] > 0.0 else 1.0)


class Unsolvable(Rosenbrock):
    """The first `times` systems of equations are singular."""

    def __init__(self, times):
        super().__init__()
        self.times = times

    def linearize(self, state, near=False):
        return _Singular(super().linearize(state, near))


class _Singular:
    def __init__(self, dense):
        self.dense, self.cost = dense, dense.cost

    def solve(self, damping):
        step = self.dense.solve(damping)
        if len(self.dense.problem.dampings) > self.dense.problem.times:
            return step
        return Step(0.0 * step.reduced, step.eliminated, 0.0 * step.predicted_decrease, torch.tensor(False))


def test_the_minimum_of_rosenbrocks_valley_is_found():
    report = minimize(Rosenbrock(), START, EXACT)

    assert report.status == "converged"
    torch.testing.assert_close(report.state, torch.ones(2, dtype=torch.float64), rtol=0.0, atol=1e-9)


def test_the_costs_start_with_that_of_the_start_and_never_rise():
    problem = Rosenbrock()

    report = minimize(problem, START, EXACT)

    assert report.costs[0] == problem.asked[0] == pytest.approx(12.1)
    assert report.costs == sorted(report.costs, reverse=True)
    assert len(problem.asked) > len(report.costs)  # some candidates were dropped
    assert report.costs[-1] == min(problem.asked)


def test_every_candidate_is_linearised_once_and_none_a_second_time_after_one_is_dropped():
    problem = Rosenbrock()

    report = minimize(problem, START, EXACT)

    assert len(problem.dampings) == report.iterations
    assert len(problem.asked) == 1 + report.iterations


def test_the_state_returned_is_that_of_the_last_cost():
    problem = Rosenbrock()

    report = minimize(problem, START, LevenbergMarquardtOptions(max_iterations=7))

    assert report.status == "max_iterations"
    assert report.iterations == 7
    assert float(problem.cost(report.state)) == report.costs[-1] < report.costs[0]


def test_the_start_is_not_changed():
    start = START.clone()

    minimize(Rosenbrock(), start, EXACT)

    assert torch.equal(start, START)


def test_the_callback_hears_of_accepted_steps_alone():
    heard = []

    report = minimize(Rosenbrock(), START, EXACT, lambda *step: heard.append(step))

    iterations, costs, dampings = zip(*heard, strict=True)
    assert list(costs) == report.costs[1:]
    assert all(damping > 0.0 for damping in dampings)
    assert list(iterations) == sorted(set(iterations))
    assert len(iterations) < report.iterations


def test_a_start_at_the_minimum_has_converged():
    report = minimize(Rosenbrock(), torch.ones(2, dtype=torch.float64), EXACT)

    assert (report.status, report.costs) == ("converged", [0.0])


def test_a_smaller_function_tolerance_takes_more_iterations():
    coarse, fine = (
        minimize(Rosenbrock(), START, LevenbergMarquardtOptions(function_tolerance=tolerance)).iterations
        for tolerance in (0.5, 1e-14)
    )

    assert coarse < fine


def test_where_no_step_goes_down_the_search_stalls_at_the_start():
    report = minimize(Uphill(), START, LevenbergMarquardtOptions())

    assert report.status == "stalled"
    assert torch.equal(report.state, START)
    assert len(report.costs) == 1


def test_no_iterations_leave_the_start():
    report = minimize(Rosenbrock(), START, LevenbergMarquardtOptions(max_iterations=0))

    assert (report.status, report.iterations) == ("max_iterations", 0)
    assert torch.equal(report.state, START)


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_start_whose_cost_is_no_number_is_reported(value):
    start = torch.tensor([value, 0.0], dtype=torch.float64)

    report = minimize(Rosenbrock(), start, LevenbergMarquardtOptions())

    assert (report.status, report.iterations) == ("not_finite", 0)
    assert report.state is start


def test_a_candidate_whose_cost_is_no_number_is_dropped():
    report = minimize(Cliff(), START, EXACT)

    assert math.isfinite(report.costs[-1])
    assert report.costs[-1] < report.costs[0]
    assert report.state[0] <= 0.0


def test_a_singular_system_is_tried_again_with_more_damping():
    problem = Unsolvable(times=3)

    report = minimize(problem, START, EXACT)

    assert report.status == "converged"
    assert problem.dampings[:4] == pytest.approx([1e-4, 2e-4, 8e-4, 64e-4])


def test_dropped_steps_double_quadruple_the_damping_and_so_on_until_one_is_accepted():
    problem, accepted = Rosenbrock(), []

    minimize(problem, START, EXACT, lambda iteration, *_: accepted.append(iteration))

    factor, dropped_after_accepted = 2.0, 0
    for iteration, (before, after) in enumerate(pairwise(problem.dampings), start=1):
        if iteration in accepted:
            assert after > 0.333 * before
            factor = 2.0
        else:
            assert after == pytest.approx(factor * before)
            factor *= 2.0
            dropped_after_accepted += iteration - 1 in accepted
    assert dropped_after_accepted > 1


def test_a_step_that_does_what_the_model_says_divides_the_damping_by_three():
    problem = Line()

    minimize(problem, torch.zeros(2, dtype=torch.float64), EXACT)

    assert problem.dampings[:2] == pytest.approx([1e-4, 1e-4 / 3.0])


def test_a_linear_problem_is_solved_by_one_undamped_step():
    options = LevenbergMarquardtOptions(max_iterations=1, initial_damping=0.0)

    report = minimize(Line(), torch.zeros(2, dtype=torch.float64), options)

    torch.testing.assert_close(report.state, torch.tensor([3.0, -1.0], dtype=torch.float64))
    assert report.costs[-1] == pytest.approx(2.0)
