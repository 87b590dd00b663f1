"""Conjugate gradients on the reduced system against the dense solution."""

from dataclasses import replace

import pytest
import torch

from tests.optim.linear_problems import DenseElimination, flat, with_gauge
from torchrefrac.optim import Blocks, Elimination, IterativeOptions, Linearized, solve_dense, solve_iteratively

SHAPES = [
    {},
    {"families": [(3, 2), (1, 1)]},
    {"families": [(2, 2)], "extra": 3},
    {"extra": 3},
    {"cameras": 9, "points": 150, "pairs": 500, "families": [(2, 3)]},
    {"cameras": 16, "points": 20, "pairs": 110, "families": [(2, 1)]},  # more blocks than rows: never formed
]
shapes = pytest.mark.parametrize("shape", SHAPES, ids=str)
TIGHT = IterativeOptions(tolerance=1e-11, forcing=0.0, cluster=1)


@shapes
@pytest.mark.parametrize("damping", [0.0, 1e-4, 1.0])
@pytest.mark.parametrize("directions", [None, 0, 3])
def test_the_solution_is_the_dense_one(make_linear, draw, cut, shape, damping, directions):
    cut(tile=8, elements=1 << 12, gram=4, cached=50)
    elimination = Elimination(make_linear(**shape).system(), damping)
    coarse = None if directions is None else draw.normal(elimination.system.plan.size, directions)

    solution, solved = solve_iteratively(elimination, coarse, TIGHT)

    assert solved
    torch.testing.assert_close(solution, solve_dense(elimination)[0], rtol=1e-6, atol=1e-7)


@shapes
def test_the_whole_step_is_that_of_the_full_normal_equations(make_linear, shape):
    linear = make_linear(**shape)

    step = Linearized(linear.system(), "iterative", TIGHT).solve(1e-3)

    torch.testing.assert_close(flat(step), linear.dense_step(1e-3), rtol=1e-6, atol=1e-7)


@shapes
@pytest.mark.parametrize("cluster", [2, 4, 100])
def test_with_clusters_of_any_size_the_solution_is_the_same(make_linear, cut, shape, cluster):
    cut(tile=8)
    elimination = Elimination(make_linear(**shape).system(), 1e-4)

    solution, solved = solve_iteratively(elimination, None, replace(TIGHT, cluster=cluster))

    assert solved
    torch.testing.assert_close(solution, solve_dense(elimination)[0], rtol=1e-6, atol=1e-7)


def test_one_cluster_of_everything_is_all_there_is(make_linear):
    elimination = Elimination(make_linear(cameras=16, points=150, pairs=700).system(), 1e-4)

    solution, _ = solve_iteratively(elimination, None, IterativeOptions(0.0, 1, 0.0, 100))

    torch.testing.assert_close(solution, solve_dense(elimination)[0], rtol=1e-9, atol=1e-11)


def test_the_larger_the_clusters_the_nearer_is_a_search_that_is_cut_short(make_chain):
    linear = make_chain(cameras=40, points=400)
    elimination = Elimination(linear.system(locality=torch.arange(400)), 1e-4)
    exact, _ = solve_dense(elimination)
    matrix, _ = elimination.reduced()
    matrix = matrix.tril() + matrix.tril(-1).T + 1e-4 * torch.diag(elimination.system.diagonal)

    def lack(cluster: int) -> float:
        solution, _ = solve_iteratively(elimination, None, IterativeOptions(0.0, 8, 0.0, cluster))
        return float((solution - exact) @ matrix @ (solution - exact))

    assert lack(20) < lack(5) < lack(1)


def test_a_search_may_end_where_going_on_promises_little(make_chain):
    """By the share of the decrease of the quadratic model that is left."""
    elimination = Elimination(make_chain(cameras=40, points=400).system(), 1e-4)
    exact, _ = solve_dense(elimination)
    _, gradient = elimination.reduced()

    left = []
    for forcing in (0.5, 0.1, 1e-3):
        solution, solved = solve_iteratively(elimination, None, IterativeOptions(0.0, 500, forcing, 1))
        assert solved
        left.append(1.0 - float(gradient @ solution) / float(gradient @ exact))  # of a search that starts from zero

    assert left[0] > left[1] > left[2]
    assert left[1] < 0.2
    assert left[2] < 1e-2


def test_what_nothing_depends_on_stands_still(make_linear, draw):
    linear = make_linear(families=[(2, 5)], extra=2)
    linear = replace(linear, terms=())
    linear.by_reduced[linear.camera == 1, :, 2:5] = 0.0
    linear = linear.where((linear.point != 4) & (linear.camera != 2))
    elimination = Elimination(linear.system(), 1e-3)

    for coarse in (None, draw.normal(linear.size, 3)):
        solution, solved = solve_iteratively(elimination, coarse, TIGHT)

        assert solved
        torch.testing.assert_close(solution, solve_dense(elimination)[0], rtol=1e-6, atol=1e-7)
        assert solution[[8, 9, 10, *range(12, 18), -1, -2]].abs().amax() < 1e-12


def test_a_looser_tolerance_leaves_a_greater_residual(make_linear):
    linear = make_linear(cameras=9, points=150, pairs=500)
    elimination, dense = Elimination(linear.system(), 1e-4), DenseElimination.of(linear, 1e-4)
    system = dense.b + 1e-4 * torch.diag(dense.b.diagonal()) - dense.e @ dense.v_inverse @ dense.e.T
    right = dense.e @ dense.v_inverse @ dense.eliminated_gradient - dense.reduced_gradient

    residuals = []
    for tolerance in (1e-1, 1e-4, 1e-8):
        solution, _ = solve_iteratively(elimination, None, IterativeOptions(tolerance, forcing=0.0, cluster=1))
        residuals.append(float((system @ solution - right).norm() / right.norm()))

    assert residuals == sorted(residuals, reverse=True)
    assert 1e-8 < residuals[1] < 1e-2
    assert residuals[2] < 1e-6


def test_a_search_that_is_cut_short_has_a_step_that_goes_down(make_linear):
    linear = make_linear(cameras=9, points=150, pairs=500, families=[(2, 3)])
    jacobian, residual = linear.rows()

    step = Linearized(linear.system(), "iterative", IterativeOptions(1e-12, max_iterations=3, cluster=1)).solve(1e-4)

    assert step.solved
    after = residual + jacobian[:, :-1] @ flat(step)
    decrease = 0.5 * (residual.square().sum() - after.square().sum())
    assert decrease > 0.0
    torch.testing.assert_close(step.predicted_decrease, decrease, rtol=1e-9, atol=0.0)


@pytest.mark.parametrize("iterations", [1, 5])
def test_units_of_the_unknowns_do_not_matter_to_a_search_that_is_cut_short(make_linear, draw, iterations):
    linear, unit = make_linear(families=[(3, 1)]), draw.power_of_ten(-8.0, 8.0, 12)
    units, coarse = torch.cat((unit[:6].repeat(5), unit[6:9])), draw.normal(33, 2)

    one, other = (
        solve_iteratively(Elimination(problem.system(), 1e-4), by, IterativeOptions(0.0, iterations, 0.0, 1))[0]
        for problem, by in ((linear, coarse), (linear.in_units(unit), coarse / units[:, None]))
    )

    torch.testing.assert_close(other * units, one, rtol=1e-7, atol=1e-9)


def test_coarse_directions_in_which_the_cost_is_nearly_flat_are_taken_at_once(make_linear, draw):
    linear = make_linear(cameras=9, points=150, pairs=500)
    blind, weak = with_gauge(linear, draw)
    linear = replace(
        blind,
        by_reduced=blind.by_reduced + 1e-3 * (linear.by_reduced - blind.by_reduced),
        by_eliminated=blind.by_eliminated + 1e-3 * (linear.by_eliminated - blind.by_eliminated),
    )
    elimination = Elimination(linear.system(), 1e-9)
    exact, _ = solve_dense(elimination)

    def error(coarse):
        solution, _ = solve_iteratively(elimination, coarse, IterativeOptions(1e-14, 25, 0.0, 1))
        return float((solution - exact).norm() / exact.norm())

    assert error(weak) < 1e-3 * error(None)


@pytest.mark.parametrize("damping", [0.0, 1e-14, 1e-4])
@pytest.mark.parametrize("families", [(), ((2, 1),)], ids=str)
@pytest.mark.parametrize("with_coarse", [False, True])
def test_a_gauge_leaves_a_step_that_satisfies_the_normal_equations(make_linear, draw, damping, families, with_coarse):
    """Whether or not the gauge is among the coarse directions."""
    linear, gauge = with_gauge(make_linear(cameras=9, points=150, pairs=500, families=families), draw)
    hessian, gradient = linear.dense()

    step = Linearized(linear.system(), "iterative", TIGHT, gauge if with_coarse else None).solve(damping)

    assert step.solved
    damped = hessian + damping * torch.diag(hessian.diagonal())
    assert (damped @ flat(step) + gradient).norm() < 1e-6 * gradient.norm()


@pytest.mark.parametrize("families", [(), ((2, 1),)], ids=str)
def test_a_system_with_a_direction_of_negative_curvature_has_a_step_that_still_goes_down(make_linear, families):
    linear = make_linear(cameras=9, points=150, pairs=500, families=families)
    system = linear.system()
    matrix, gradient = Elimination(system, 0.0).reduced()
    matrix = matrix.tril() + matrix.tril(-1).T
    bend = -1.05 * torch.linalg.eigvalsh(matrix)[0] * torch.eye(linear.size, dtype=torch.float64)
    everything = Blocks(torch.arange(linear.size)[None], bend[None], torch.zeros(1, linear.size, dtype=torch.float64))
    elimination = Elimination(replace(system, blocks=(*system.blocks, everything)), 0.0)

    decreases = []
    for iterations in (1, 3, 200):
        x, solved = solve_iteratively(elimination, None, IterativeOptions(1e-12, iterations, 0.0, 1))
        assert solved
        decreases.append(float(-(gradient @ x) - 0.5 * (x @ (matrix + bend) @ x)))

    assert 0.0 < decreases[0] <= decreases[1] <= decreases[2]


@pytest.mark.parametrize("families", [(), ((2, 1),)], ids=str)
def test_a_system_in_which_nothing_goes_down_is_not_solved(make_linear, families):
    """Its Hessian is negative in every direction."""
    linear = make_linear(families=families)
    system = linear.system()
    below = [block._replace(hessian=-block.hessian) for block in system.blocks]
    elimination = Elimination(replace(system, blocks=tuple(below)), 1e-4)

    solution, solved = solve_iteratively(elimination, None, IterativeOptions())

    assert not solved
    assert not solution.any()


def test_a_step_of_zero_is_called_a_solution_only_where_nothing_pulls(make_linear):
    """Camera 4 sees one point alone, and nothing is damped: rounding decides how the search ends."""
    for _ in range(40):
        linear = make_linear()
        others = linear.camera != 4
        once = (~others).nonzero()[0, 0]
        elimination = Elimination(linear.where(others | (torch.arange(45) == once)).system(), 0.0)

        solution, solved = solve_iteratively(elimination, None, IterativeOptions())

        assert solution.isfinite().all()
        assert bool(solved) == bool(solution.any())


def test_at_the_minimum_the_step_is_zero_and_solved(make_linear):
    linear = make_linear(families=[(2, 1)])

    step = Linearized(replace(linear, residual=torch.zeros_like(linear.residual)).system(), "iterative").solve(1e-4)

    assert step.solved
    assert not flat(step).any()
