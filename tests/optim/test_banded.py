"""The block tridiagonal factorisation with a border against the dense one."""

from dataclasses import replace

import pytest
import torch

from tests.optim.linear_problems import DenseElimination, flat, with_gauge
from torchrefrac.optim import (
    Covariance,
    Elimination,
    GaussNewtonInverse,
    Linearized,
    SingularError,
    choice,
    choose,
    covariance,
    solve_banded,
    solve_dense,
)
from torchrefrac.optim.blocks import ReducedBlocks
from torchrefrac.optim.ordering import BandedOrder

SHAPES = [
    {},
    {"families": [(2, 1)]},
    {"families": [(3, 2), (1, 1)], "extra": 3},
    {"extra": 2},
    {"ends": True},
    {"cameras": 9, "points": 40},
]
shapes = pytest.mark.parametrize("shape", SHAPES, ids=str)
SECTIONS = [6, 30, 96]


@pytest.fixture(params=SECTIONS, ids=lambda size: f"section{size}", autouse=True)
def section(request, cut):
    cut(tile=1, section=request.param)
    return request.param


@pytest.fixture
def only_banded(monkeypatch):
    """However few unknowns there are."""
    monkeypatch.setattr(choice, "SMALL", 0)
    monkeypatch.setattr(covariance, "MAX_COVARIANCE", 0)


def close(actual, expected, slack=1e-10):
    torch.testing.assert_close(actual, expected, rtol=0.0, atol=slack * float(expected.abs().max()))


@shapes
def test_blocks_are_the_damped_schur_complement(make_chain, draw, shape):
    linear = make_chain(**shape)
    dense, x = DenseElimination.of(linear, 0.1), draw.normal(linear.size)

    blocks = ReducedBlocks.of(Elimination(linear.system(), 0.1))

    matrix = dense.b + 0.1 * torch.diag(dense.b.diagonal()) - dense.e @ dense.v_inverse @ dense.e.T
    close(blocks.times(x), matrix @ x)
    close(blocks.diagonal, matrix.diagonal())
    close(blocks.gradient, dense.reduced_gradient - dense.e @ dense.v_inverse @ dense.eliminated_gradient)


@shapes
@pytest.mark.parametrize("damping", [0.0, 1e-4, 1.0])
def test_the_solution_is_the_dense_one(make_chain, shape, damping):
    elimination = Elimination(make_chain(**shape).system(), damping)

    solution, solved = solve_banded(elimination)

    assert solved
    close(solution, solve_dense(elimination)[0])


@shapes
def test_the_whole_step_is_that_of_the_full_normal_equations(make_chain, shape):
    linear = make_chain(**shape)

    step = Linearized(linear.system(), "banded").solve(1e-3)

    close(flat(step), linear.dense_step(1e-3))


@pytest.mark.parametrize("families", [(), ((2, 1),)], ids=str)
@pytest.mark.parametrize("damping", [0.0, 1e-6, 1.0])
def test_with_a_gauge_the_solution_is_the_dense_one(make_chain, draw, damping, families):
    linear, null_space = with_gauge(make_chain(families=families), draw)
    elimination = Elimination(linear.system(null_space), damping)

    solution, solved = solve_banded(elimination)

    assert solved
    close(solution, solve_dense(elimination)[0])


def test_what_nothing_depends_on_stands_still(make_chain):
    linear = replace(make_chain(families=[(2, 5)], extra=2), terms=())
    linear.by_reduced[linear.camera == 1, :, 2:5] = 0.0
    linear = linear.where((linear.point != 4) & (linear.camera != 2))
    elimination = Elimination(linear.system(), 1e-3)

    solution, solved = solve_banded(elimination)

    assert solved
    close(solution, solve_dense(elimination)[0])
    assert not solution[[8, 9, 10, *range(12, 18), -1, -2]].any()


def test_a_singular_system_has_no_step(make_chain, draw):
    """A gauge that is not said: the dense solver says the same."""
    linear, _ = with_gauge(make_chain(), draw)
    elimination = Elimination(linear.system(), 0.0)

    solution, solved = solve_banded(elimination)

    assert not solved
    assert not solve_dense(elimination)[1]
    assert not solution.any()


@shapes
def test_what_meets_lies_in_a_section_in_the_next_one_or_in_the_border(make_chain, shape, section):
    linear = make_chain(**shape)
    system = linear.system()

    order = BandedOrder.of(system)

    assert sorted(order.position.tolist()) == list(range(linear.size))
    assert all(size >= section for size in order.sizes[:-1])
    which = torch.repeat_interleave(torch.arange(len(order.sizes)), torch.tensor(order.sizes))
    place = order.position[6 * system.pairs]
    inner = place[(place < order.inner).all(dim=1)]
    assert (which[inner].diff(dim=1).abs() <= 1).all()


def test_a_camera_that_meets_most_others_is_left_to_the_border(make_chain):
    linear = make_chain(cameras=60, points=600, ends=True)

    order = BandedOrder.of(linear.system())

    hub = torch.bincount(linear.camera).argmax()
    assert order.border == 6
    assert (order.position[6 * hub : 6 * hub + 6] >= order.inner).all()


@pytest.mark.parametrize("gauge", [False, True])
@pytest.mark.parametrize("shape", [{}, {"families": [(2, 2)]}, {"ends": True}], ids=str)
def test_the_covariance_is_the_dense_one_where_blocks_meet(make_chain, draw, only_banded, monkeypatch, shape, gauge):
    linear, null_space = with_gauge(make_chain(**shape), draw)
    linear, null_space = (linear, null_space) if gauge else (make_chain(**shape), None)
    system = linear.system(null_space)
    pairs = torch.cat((system.pairs, torch.arange(linear.num_reduced)[:, None].expand(-1, 2)))
    rows, columns = (6 * pairs[..., None] + torch.arange(6)).unbind(dim=1)
    every = torch.arange(linear.size)
    shared = every[6 * linear.num_reduced - 1 :]  # and the last of a camera
    functional = draw.normal(linear.size)

    found = Covariance.of(system)

    monkeypatch.setattr(covariance, "choose", lambda *_, **__: choice.Method("dense"))
    dense = Covariance.of(system)
    for one, other in ((rows[:, :, None], columns[:, None]), (shared[:, None], shared), (every, every)):
        close(found.among[one, other], dense.reduced[one, other], 1e-9)
    close(found.eliminated(), dense.eliminated(), 1e-9)
    variance = found.inverse.deviations(functional[:, None])[0].square()
    close(variance, dense.reduced @ functional @ functional, 1e-9)
    draws = draw.normal(3, linear.size)
    summed = found.among.times(2.0).plus(draws)[every, every]
    close(summed, dense.among.times(2.0).plus(draws)[every, every], 1e-9)
    with pytest.raises(SingularError, match="reduced unknowns is there in part only"):
        _ = found.reduced


def test_the_inverse_of_the_whole_matrix_is_the_dense_one(make_chain, draw, only_banded):
    linear = make_chain(families=[(2, 1)])
    hessian, _ = linear.dense()
    vector = draw.normal(len(hessian))

    close(hessian @ GaussNewtonInverse.of(linear.system())(vector), vector)


def test_an_undetermined_direction_raises(make_chain, draw, only_banded):
    linear, null_space = with_gauge(make_chain(), draw)

    with pytest.raises(SingularError, match="the normal equations are singular"):
        Covariance.of(linear.system(null_space[:, :3]))


def test_the_method_is_the_cheapest_that_fits(make_chain, monkeypatch):
    system = make_chain().system()

    assert choose(system).name == "dense"
    assert choose(system, "banded").name == "banded"
    monkeypatch.setattr(choice, "SMALL", 0)
    assert choose(system, max_dense=0).name == "banded"
    monkeypatch.setattr(choice, "MAX_NUMBERS", 10)
    assert choose(system).name == "dense"
    assert choose(system, max_dense=0).name == "iterative"
