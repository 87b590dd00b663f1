"""Many small least-squares problems at once."""

from collections.abc import Callable
from dataclasses import dataclass

import pytest
import torch
from scipy.optimize import least_squares
from torch import Tensor

from tests.tolerances import DTYPES, assert_matches
from torchrefrac.optim import Quadratic, minimize_each
from torchrefrac.optim.batched import covariance_of, solve_damped

TIGHT = {"max_iterations": 200, "tolerance": 1e-15}


@dataclass
class Squares:
    """K problems with residuals (K, R) = function(states (K, D), data (K, ...)), differentiated by autograd.

    `impossible` gives the states whose cost becomes `bad`. Counts its evaluations.
    """

    function: Callable[[Tensor, Tensor], Tensor]
    data: Tensor
    impossible: Callable[[Tensor], Tensor] | None = None
    bad: float = float("inf")
    evaluations: int = 0

    def linearize(self, states: Tensor) -> Quadratic:
        self.evaluations += 1
        residual = self.function(states, self.data)
        by_state = torch.autograd.functional.jacobian(lambda x: self.function(x, self.data).sum(dim=0), states)
        jacobian = by_state.movedim(1, 0)
        cost = 0.5 * residual.square().sum(dim=-1)
        if self.impossible is not None:
            cost = torch.where(self.impossible(states), self.bad, cost)
        return Quadratic(cost, (jacobian.mT @ residual[..., None])[..., 0], jacobian.mT @ jacobian)

    def cost(self, states: Tensor) -> Tensor:
        return 0.5 * self.function(states, self.data).square().sum(dim=-1)

    def alone(self, k: int) -> "Squares":
        return Squares(self.function, self.data[k : k + 1], self.impossible, self.bad)


class Parting(Squares):
    """The same, of which some can be left out. Keeps how many problems every evaluation had."""

    def __init__(self, squares: Squares, sizes: list[int] | None = None) -> None:
        super().__init__(squares.function, squares.data, squares.impossible, squares.bad)
        self.sizes = [] if sizes is None else sizes

    def linearize(self, states: Tensor) -> Quadratic:
        self.sizes.append(len(states))
        return super().linearize(states)

    def subset(self, rows: Tensor) -> "Parting":
        return Parting(Squares(self.function, self.data[rows], self.impossible, self.bad), self.sizes)


def valley(x, data):
    """Rosenbrock's valley, its bend and its end given by data (K, 2)."""
    return torch.stack((3.0 * (x[:, 1] - data[:, 0] * x[:, 0] ** 2), data[:, 1] - x[:, 0]), dim=-1)


def circle(x, data):
    """Distances of points (K, n, 2) from the circle about x[:2] with radius x[2]."""
    return (data - x[:, None, :2]).norm(dim=-1) - x[:, 2:]


def fall(x, data):
    """x[0] exp(-x[1] t) + x[2] against the values (K, n)."""
    time = torch.linspace(0.0, 3.0, data.shape[1], dtype=x.dtype)
    return x[:, :1] * torch.exp(-x[:, 1:2] * time) + x[:, 2:] - data


def line(x, data):
    """x - data: one step solves it."""
    return x - data


@pytest.fixture
def problems(draw) -> dict[str, tuple[Squares, Tensor]]:
    """Each kind with six problems and their starts."""
    angle = draw.uniform(0.0, 4.0, 6, 15)
    arc = 3.0 * torch.stack((angle.cos(), angle.sin()), dim=-1) + draw.uniform(-5.0, 5.0, 6, 1, 2)
    time = torch.linspace(0.0, 3.0, 20, dtype=torch.float64)
    falling = 2.0 * torch.exp(-draw.uniform(0.5, 2.0, 6, 1) * time) + draw.uniform(-1.0, 1.0, 6, 1)
    middle = arc.mean(dim=1)
    radius = draw.uniform(1.0, 6.0, 6, 1)
    return {
        "valley": (Squares(valley, draw.uniform(0.5, 2.0, 6, 2)), draw.uniform(-2.0, 2.0, 6, 2)),
        "circle": (
            Squares(circle, arc + 0.1 * draw.normal(6, 15, 2)),
            torch.cat((middle + 0.3 * draw.normal(6, 2), radius), dim=-1),
        ),
        "fall": (Squares(fall, falling + 0.05 * draw.normal(6, 20)), draw.uniform(0.5, 1.5, 6, 3)),
    }


kinds = pytest.mark.parametrize("kind", ["valley", "circle", "fall"])


@kinds
def test_each_problem_ends_where_scipy_ends(problems, kind):
    squares, start = problems[kind]

    report = minimize_each(squares, start, **TIGHT)

    assert report.converged.all()
    for k, x in enumerate(start):
        alone = squares.alone(k)

        def residual(x, alone=alone):
            return alone.function(torch.from_numpy(x)[None], alone.data)[0].numpy()

        oracle = least_squares(residual, x.numpy(), xtol=1e-15, ftol=1e-15, gtol=1e-15)
        torch.testing.assert_close(report.states[k], torch.from_numpy(oracle.x), rtol=1e-6, atol=1e-6)
        assert float(report.quadratic.cost[k]) == pytest.approx(oracle.cost, rel=1e-9, abs=1e-12)


@kinds
@pytest.mark.parametrize("iterations", [1, 4, 60])
def test_each_problem_of_a_batch_ends_where_it_ends_alone(problems, kind, iterations):
    squares, start = problems[kind]

    together = minimize_each(squares, start, iterations)

    for k in range(len(start)):
        alone = minimize_each(squares.alone(k), start[k : k + 1], iterations)
        torch.testing.assert_close(together.states[k], alone.states[0], rtol=1e-9, atol=1e-9)
        assert together.converged[k] == alone.converged[0]


@kinds
@pytest.mark.parametrize("damping", [0.0, 1e-4, 1e3])
@pytest.mark.parametrize("iterations", [0, 1, 3, 20])
def test_no_state_ends_worse_than_it_began(problems, draw, kind, damping, iterations):
    squares, start = problems[kind]
    start = start + draw.normal(*start.shape)

    report = minimize_each(squares, start, iterations, damping=damping)

    assert report.states.isfinite().all()
    assert (squares.cost(report.states) <= squares.cost(start)).all()


@kinds
def test_the_model_that_is_reported_belongs_to_the_states(problems, kind):
    squares, start = problems[kind]

    report = minimize_each(squares, start, 3)

    for reported, there in zip(report.quadratic, squares.linearize(report.states), strict=True):
        assert torch.equal(reported, there)


@kinds
@pytest.mark.parametrize("iterations", [0, 1, 5, 60])
def test_problems_that_leave_end_as_those_that_stay(problems, kind, iterations):
    squares, start = problems[kind]
    start = torch.cat((start, minimize_each(squares, start, 60).states, start))
    squares = Squares(squares.function, squares.data.repeat(3, *(1 for _ in squares.data.shape[1:])))
    parting = Parting(squares)

    stay, leave = minimize_each(squares, start, iterations), minimize_each(parting, start, iterations)

    torch.testing.assert_close(leave.states, stay.states, rtol=1e-9, atol=1e-9)
    assert torch.equal(leave.converged, stay.converged)
    for left, stayed in zip(leave.quadratic, stay.quadratic, strict=True):
        torch.testing.assert_close(left, stayed, rtol=1e-7, atol=1e-9)
    assert sum(parting.sizes) <= squares.evaluations * len(start)
    assert iterations == 0 or parting.sizes[1] == 12


def test_problems_that_have_converged_are_not_looked_at_again(draw):
    """A third each needs one step, several steps, and has no way to go; a constant is left of the cost."""

    def function(x, data):
        return torch.cat(((x - data[:, :2]) ** data[:, 2:], torch.ones_like(x)), dim=1)

    goal = draw.normal(9, 2)
    powers = torch.tensor([1.0, 3.0, 1.0], dtype=torch.float64).repeat(3)[:, None]
    start = torch.where(torch.arange(9)[:, None] % 3 == 2, goal, goal + draw.uniform(1.0, 2.0, 9, 2))
    parting = Parting(Squares(function, torch.cat((goal, powers), dim=1)))

    report = minimize_each(parting, start, 60)

    assert report.converged.all()
    assert parting.sizes[0] == 9
    assert parting.sizes[1] == 6
    assert parting.sizes[-1] <= 3
    assert parting.sizes == sorted(parting.sizes, reverse=True)
    torch.testing.assert_close(report.states[::3], goal[::3], rtol=0.0, atol=1e-3)
    assert torch.equal(report.states[2::3], goal[2::3])


def test_an_impossible_problem_does_not_keep_the_others_from_leaving():
    start = torch.tensor([[4.0], [-2.0], [1.0], [3.0]], dtype=torch.float64)
    parting = Parting(Squares(line, torch.zeros_like(start), lambda x: x[:, 0] < -1.0))
    parting.data[1] = -5.0

    report = minimize_each(parting, start)

    assert report.converged.tolist() == [True, False, True, True]
    assert float(report.states[1]) == -2.0
    torch.testing.assert_close(report.states[[0, 2, 3]], torch.zeros(3, 1, dtype=torch.float64), rtol=0.0, atol=1e-6)
    assert parting.sizes[-1] == 1


@pytest.mark.parametrize("bad", [float("inf"), float("nan")])
def test_a_candidate_of_infinite_or_nan_cost_is_rejected(bad):
    """The undamped step goes to zero at once; beyond 0.3 is forbidden ground."""
    start = torch.tensor([[4.0], [-2.0], [1.0]], dtype=torch.float64)
    squares = Squares(line, torch.zeros_like(start), lambda x: x[:, 0].abs() < 0.3, bad)

    report = minimize_each(squares, start, 60)

    assert (report.states.abs() >= 0.3).all()
    assert (report.states.abs() < start.abs()).all()
    assert torch.equal(report.states.sign(), start.sign())
    assert report.quadratic.cost.isfinite().all()


@pytest.mark.parametrize("bad", [float("inf"), float("nan")])
def test_an_impossible_start_has_not_converged_and_spoils_no_other(bad):
    start = torch.tensor([[4.0], [-2.0], [1.0]], dtype=torch.float64)
    squares = Squares(line, torch.zeros_like(start), lambda x: x[:, 0] < -1.0, bad)
    squares.data[1] = -5.0

    report = minimize_each(squares, start)

    assert report.converged.tolist() == [True, False, True]
    assert float(report.states[1]) == -2.0
    torch.testing.assert_close(report.states[[0, 2]], torch.zeros(2, 1, dtype=torch.float64), rtol=0.0, atol=1e-6)


def test_unknowns_that_nothing_depends_on_stay_as_they_are(draw):
    start = draw.normal(5, 3)
    squares = Squares(lambda x, data: x[:, :2] - data, draw.normal(5, 2))

    report = minimize_each(squares, start, **TIGHT)

    torch.testing.assert_close(report.states[:, :2], squares.data, rtol=0.0, atol=1e-9)
    assert torch.equal(report.states[:, 2], start[:, 2])
    assert report.converged.all()


def test_a_problem_with_fewer_residuals_than_unknowns_goes_on_until_its_cost_is_least(draw):
    """Steps of a third: the damping dies out long before the end, and the Hessian is singular."""
    start = draw.normal(5, 3)
    squares = Squares(lambda x, data: (x.sum(dim=-1, keepdim=True) - data) ** 3, draw.uniform(3.0, 9.0, 5, 1))

    report = minimize_each(squares, start, **TIGHT)

    assert (squares.cost(report.states) < 1e-15 * squares.cost(start)).all()
    assert report.states.isfinite().all()


@pytest.mark.parametrize("damping", [0.0, 1.0])
def test_a_hessian_that_is_not_positive_definite_gives_no_step(damping):
    saddle = torch.tensor([[1.0, 3.0], [3.0, 1.0]], dtype=torch.float64)
    flat, unknown = torch.ones(2, 2, dtype=torch.float64), torch.full((2, 2), torch.nan, dtype=torch.float64)
    sound = torch.eye(2, dtype=torch.float64)
    gradient = torch.ones(4, 2, dtype=torch.float64)
    quadratic = Quadratic(torch.ones(4), gradient, torch.stack((saddle, flat, unknown, sound)))

    step = solve_damped(quadratic, torch.full((4,), damping, dtype=torch.float64))

    assert step.isfinite().all()
    assert not step[[0, 2]].any()
    if damping == 0.0:
        assert not step[1].any()
    assert_matches(step[3], -gradient[3] / (1.0 + damping))


def test_where_no_model_has_a_minimum_the_state_stays_and_has_not_converged():
    class Saddle:
        def linearize(self, states):
            hessian = states.new_tensor([[1.0, 3.0], [3.0, 1.0]]).expand(len(states), 2, 2)
            return Quadratic(states.square().sum(dim=-1), states, hessian)

    start = torch.tensor([[1.0, 2.0]])

    report = minimize_each(Saddle(), start, max_iterations=2)

    assert torch.equal(report.states, start)
    assert not report.converged.any()


def test_the_step_is_that_of_a_dense_solve_whatever_the_units(draw):
    factor, damping = draw.normal(6, 9, 4), draw.power_of_ten(-4.0, 2.0, 6)
    units = 10.0 ** torch.tensor((-6.0, 0.0, 3.0, 8.0), dtype=torch.float64)
    hessian, gradient = factor.mT @ factor, draw.normal(6, 4)

    step = solve_damped(Quadratic(draw.normal(6), gradient * units, hessian * units * units[:, None]), damping)

    damped = hessian + damping[:, None, None] * torch.diag_embed(hessian.diagonal(dim1=-2, dim2=-1))
    torch.testing.assert_close(step * units, -torch.linalg.solve(damped, gradient), rtol=1e-9, atol=1e-12)


def test_a_problem_has_converged_when_hardly_any_decrease_is_left(problems):
    squares, start = problems["circle"]

    loose, tight = (minimize_each(squares, start, 100, tolerance) for tolerance in (1e-2, 1e-12))

    least = tight.quadratic.cost
    assert loose.converged.all()
    assert tight.converged.all()
    assert (loose.quadratic.cost - least <= 2e-2 * loose.quadratic.cost).all()
    assert (loose.quadratic.cost > least).any()


def test_without_iterations_left_nothing_has_converged(problems):
    squares, start = problems["valley"]

    assert not minimize_each(squares, start, 2).converged.any()


def test_at_a_minimum_nothing_moves_and_one_evaluation_is_enough(draw):
    start = draw.normal(5, 2)
    squares = Squares(line, start)

    report = minimize_each(squares, start)

    assert report.converged.all()
    assert torch.equal(report.states, start)
    assert squares.evaluations == 1


@pytest.mark.parametrize("dtype", DTYPES)
def test_the_dtype_is_kept(draw, dtype):
    squares = Squares(line, draw.normal(5, 2).to(dtype))

    report = minimize_each(squares, torch.zeros(5, 2, dtype=dtype))

    assert report.states.dtype == report.quadratic.hessian.dtype == dtype
    torch.testing.assert_close(report.states, squares.data, rtol=1e-4, atol=1e-4)


def test_the_states_handed_in_are_not_changed(problems):
    squares, start = problems["fall"]
    before = start.clone()

    minimize_each(squares, start)

    assert torch.equal(start, before)


def test_the_covariance_is_the_inverse_of_the_information_whatever_the_units(draw):
    jacobian = draw.normal(5, 20, 4) * torch.tensor([1e-6, 1.0, 1e3, 1e6], dtype=torch.float64)
    information = jacobian.mT @ jacobian

    covariance, exists = covariance_of(information)

    assert exists.all()
    product = covariance @ information
    torch.testing.assert_close(
        product.diagonal(dim1=-2, dim2=-1), torch.ones(5, 4, dtype=torch.float64), rtol=1e-9, atol=1e-9
    )


def test_singular_information_has_no_covariance():
    singular = torch.ones(1, 3, 3, dtype=torch.float64)

    covariance, exists = covariance_of(torch.cat((singular, torch.eye(3, dtype=torch.float64)[None])))

    assert exists.tolist() == [False, True]
    assert covariance.isfinite().all()


def test_a_problem_that_no_step_improves_up_to_the_largest_damping_has_stalled(problems):
    """Steps lead uphill: the model bends the wrong way."""
    squares, start = problems["circle"]

    class Uphill:
        def linearize(self, states):
            quadratic = squares.linearize(states)
            return quadratic._replace(gradient=-quadratic.gradient)

    report = minimize_each(Uphill(), start, 100, max_damping=1e3)

    assert report.stalled.all()
    assert not report.converged.any()
    assert torch.equal(report.states, start)


def test_a_damped_step_that_promises_little_does_not_count_as_convergence_where_an_undamped_one_promises_more():
    start = torch.ones(3, 1, dtype=torch.float64)
    squares = Squares(line, torch.zeros_like(start))

    damped, undamped = (minimize_each(squares, start, 1, 1e-3, 1e4, undamped=u) for u in (False, True))

    assert damped.converged.all()
    assert not undamped.converged.any()
    assert (undamped.states < start).all()


def test_a_decrease_within_the_rounding_of_a_cost_is_convergence():
    start = torch.full((2, 1), 1e-9, dtype=torch.float64)
    squares = Squares(line, torch.zeros_like(start))

    exact, rounded = (minimize_each(squares, start, 1, rounding=r) for r in (0.0, 1e-15))

    assert not torch.equal(exact.states, start)
    assert rounded.converged.all()
    assert torch.equal(rounded.states, start)
