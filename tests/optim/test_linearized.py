"""The step of Levenberg-Marquardt by the dense solver against the full damped normal equations."""

from dataclasses import replace

import pytest
import torch

from tests.optim.linear_problems import flat, with_gauge
from torchrefrac.optim import Blocks, IterativeOptions, Linearized, linearize

SHAPES = [{}, {"families": [(3, 2), (1, 1)]}, {"families": [(2, 2)], "extra": 3}, {"extra": 3}]
shapes = pytest.mark.parametrize("shape", SHAPES, ids=str)


@shapes
@pytest.mark.parametrize("damping", [0.0, 1e-8, 1e-4, 1.0, 1e4])
def test_the_step_is_that_of_the_full_damped_normal_equations(make_linear, shape, damping):
    linear = make_linear(**shape)

    step = linear.step(damping)

    assert step.solved
    assert step.eliminated.shape == (12, 3)
    torch.testing.assert_close(flat(step), linear.dense_step(damping), rtol=1e-7, atol=1e-9)


@shapes
@pytest.mark.parametrize("damping", [0.0, 1e-2])
def test_points_that_are_held_leave_the_normal_equations_of_what_is_kept(make_linear, shape, damping):
    """These have derivatives of zero in their points."""
    linear = make_linear(**shape)
    linear = replace(linear, by_eliminated=torch.zeros_like(linear.by_eliminated))

    step = linear.step(damping)

    assert step.solved
    assert not step.eliminated.any()
    torch.testing.assert_close(flat(step), linear.dense_step(damping), rtol=1e-7, atol=1e-9)


@shapes
@pytest.mark.parametrize("damping", [0.0, 1e-2, 10.0])
@pytest.mark.parametrize("solver", ["dense", "banded", "iterative"])
def test_the_predicted_decrease_is_that_of_the_quadratic_model(make_linear, shape, damping, solver):
    linear = make_linear(**shape)
    jacobian, residual = linear.rows()

    step = Linearized(linear.system(), solver).solve(damping)

    after = residual + jacobian[:, :-1] @ flat(step)
    decrease = 0.5 * (residual.square().sum() - after.square().sum())
    torch.testing.assert_close(step.predicted_decrease, decrease, rtol=1e-6, atol=1e-9)


def test_more_damping_makes_a_shorter_step(make_linear):
    linearized = Linearized(make_linear(families=[(2, 2)], extra=1).system())

    lengths = [flat(linearized.solve(damping)).norm() for damping in (0.0, 1e-2, 1.0, 1e2)]

    assert lengths == sorted(lengths, reverse=True)


def test_observations_of_no_weight_are_as_good_as_none(make_linear):
    linear = make_linear(families=[(2, 2)], extra=2)
    ignored = torch.arange(45) % 7 == 0

    step = replace(linear, weight=torch.where(ignored, 0.0, linear.weight)).step(1e-3)

    torch.testing.assert_close(flat(step), flat(linear.where(~ignored).step(1e-3)), rtol=1e-9, atol=1e-11)


def test_units_of_the_unknowns_do_not_matter(make_linear, draw):
    linear = make_linear(families=[(2, 1)])
    unit = draw.power_of_ten(-6.0, 6.0, 11)

    one, other = linear.step(1e-4), linear.in_units(unit).step(1e-4)

    assert other.solved
    back = torch.cat((unit[:6].repeat(5), unit[6:8], unit[8:].repeat(12)))
    torch.testing.assert_close(flat(other) * back, flat(one), rtol=1e-7, atol=1e-9)
    torch.testing.assert_close(other.predicted_decrease, one.predicted_decrease, rtol=1e-9, atol=0.0)


@pytest.mark.parametrize("damping", [0.0, 1e-4])
def test_what_nothing_depends_on_stands_still_and_the_rest_moves_as_without_it(make_linear, damping):
    """A point and a camera that see nothing, unknowns of a camera that are held, and an extra one without a term."""
    linear = make_linear(pairs=58, families=[(2, 2)], extra=3)
    still = torch.tensor([8, 9, 10, *range(12, 18), linear.size - 1])
    linear.by_reduced[linear.camera == 1, :, 2:5] = 0.0
    (term,) = linear.terms
    term.columns[torch.isin(term.columns, still)] = linear.size
    linear = linear.where((linear.point != 4) & (linear.camera != 2))

    step = linear.step(damping)

    assert step.solved
    assert not step.eliminated[4].any()
    assert not step.reduced[still].any()
    torch.testing.assert_close(flat(step), linear.dense_step(damping), rtol=1e-7, atol=1e-9)


@pytest.mark.parametrize("solver", ["dense", "banded", "iterative"])
def test_a_system_without_observations_gives_a_step_of_zero(make_linear, solver):
    linear = make_linear(families=[(2, 2)])

    step = Linearized(linear.where(torch.zeros(45, dtype=torch.bool)).system(), solver).solve(1e-4)

    assert step.solved
    assert not flat(step).any()
    assert step.predicted_decrease == 0.0


def test_a_singular_system_is_not_solved_and_what_is_kept_stays(make_linear):
    """Camera 4 sees one point alone."""
    linear = make_linear()
    others = linear.camera != 4
    once = (~others).nonzero()[0, 0]

    step = linear.where(others | (torch.arange(45) == once)).step(0.0)

    assert not step.solved
    assert not step.reduced.any()


@pytest.mark.parametrize("solver", ["dense", "banded", "iterative"])
@pytest.mark.parametrize("bad", [torch.nan, torch.inf])
@pytest.mark.parametrize("families", [(), ((3, 1),)], ids=str)
def test_derivatives_that_are_no_numbers_are_not_solved_and_what_is_kept_stays(make_linear, solver, bad, families):
    linear = make_linear(families=families)
    linear.by_reduced[3, 0, 0] = bad

    step = Linearized(linear.system(), solver).solve(1e-4)

    assert not step.solved
    assert not step.reduced.any()


@shapes
def test_along_the_null_space_the_undamped_step_stands_still(make_linear, draw, shape):
    linear, gauge = with_gauge(replace(make_linear(**shape), terms=(), num_extra=0), draw)
    hessian, gradient = linear.dense()
    assert torch.linalg.eigvalsh(hessian)[3] < 1e-10

    step = linear.step(0.0, gauge)

    assert step.solved
    assert (gauge.T @ step.reduced).abs().amax() < 1e-9
    torch.testing.assert_close(hessian @ flat(step), -gradient, rtol=0.0, atol=1e-8)


def test_along_the_null_space_a_slightly_damped_step_hardly_moves(make_linear, draw):
    linear, gauge = with_gauge(make_linear(families=[(2, 1)]), draw)

    step = linear.step(1e-4, gauge)

    assert (gauge.T @ step.reduced).norm() < 1e-2 * step.reduced.norm()


def test_the_solver_is_dense_up_to_a_size_and_beyond_it_banded_or_iterative(make_linear, monkeypatch):
    system = make_linear(families=[(2, 2)]).system()
    dense, banded, iterative = (
        flat(Linearized(system, solver).solve(1e-3)) for solver in ("dense", "banded", "iterative")
    )
    assert not torch.equal(dense, iterative)
    assert not torch.equal(dense, banded)

    assert torch.equal(flat(Linearized(system).solve(1e-3)), dense)

    monkeypatch.setattr("torchrefrac.optim.choice.SMALL", system.plan.size - 1)
    monkeypatch.setattr("torchrefrac.optim.choice.MAX_DENSE", system.plan.size)
    assert torch.equal(flat(Linearized(system).solve(1e-3)), dense)

    monkeypatch.setattr("torchrefrac.optim.choice.MAX_DENSE", system.plan.size - 1)
    assert torch.equal(flat(Linearized(system).solve(1e-3)), banded)

    monkeypatch.setattr("torchrefrac.optim.choice.MAX_FLOPS", 0.0)
    assert torch.equal(flat(Linearized(system).solve(1e-3)), iterative)


@pytest.mark.parametrize("solver", ["dense", "banded", "iterative"])
def test_the_dtype_is_kept(make_linear, solver):
    linear = make_linear(families=[(2, 2)], extra=2)
    system = linear.system()
    terms = [Blocks(b.columns, b.hessian.float(), b.gradient.float()) for b in system.blocks[1:]]
    single = linearize(system.plan, system.rows.float(), system.cost.float(), terms)

    step = Linearized(single, solver, IterativeOptions(forcing=0.0)).solve(1.0)

    assert step.reduced.dtype == step.eliminated.dtype == step.predicted_decrease.dtype == torch.float32
    torch.testing.assert_close(flat(step).double(), linear.dense_step(1.0), rtol=1e-3, atol=1e-4)
