"""The normal equations against those built observation by observation."""

import pytest
import torch

from tests.optim.linear_problems import at_places, of_eliminated
from tests.tolerances import assert_matches
from torchrefrac.optim import Blocks, Elimination
from torchrefrac.optim.normal_equations import LOWER, in_cache

SHAPES = [
    {},
    {"families": [(2, 1)]},
    {"families": [(3, 2)]},
    {"families": [(3, 2), (1, 1), (2, 3)]},
    {"families": [(1, 2)], "extra": 4},
    {"extra": 3},
]
shapes = pytest.mark.parametrize("shape", SHAPES, ids=str)
cuts = pytest.mark.parametrize(("gram", "cached"), [(256, 16384), (4, 7), (1, 1)])


@shapes
@cuts
def test_what_is_kept_has_the_hessian_and_gradient_of_the_full_normal_equations(make_linear, cut, shape, gram, cached):
    cut(gram=gram, cached=cached)
    linear = make_linear(**shape)
    hessian, gradient = linear.dense()
    k = linear.size

    system = linear.system()

    assert system.plan.size == k
    assert_matches(system.dense(), hessian[:k, :k], slack=10.0)
    assert_matches(system.diagonal, hessian.diagonal()[:k], slack=10.0)
    assert_matches(system.gradient, gradient[:k], slack=10.0)


@shapes
def test_applying_the_hessian_is_multiplying_by_it(make_linear, draw, shape):
    linear = make_linear(**shape)
    hessian, _ = linear.dense()
    x = draw.normal(linear.size)

    assert_matches(linear.system().apply(x), hessian[: linear.size, : linear.size] @ x, slack=100.0)


@cuts
def test_the_points_have_the_hessian_and_gradient_of_the_full_normal_equations(make_linear, cut, gram, cached):
    cut(tile=4, gram=gram, cached=cached)
    linear = make_linear(families=[(2, 1)])
    hessian, gradient = linear.dense()
    k = linear.size

    system = linear.system()

    places = Elimination(system, 0.0)
    assert_matches(of_eliminated(places, system.eliminated_gradient), gradient[k:], slack=10.0)
    blocks = hessian[k:, k:].view(12, 3, 12, 3).diagonal(dim1=0, dim2=2)
    lower = torch.stack([blocks[i, j] for i, j in LOWER])
    assert_matches(system.eliminated_hessian[:, system.plan.place_of], lower, slack=10.0)


def test_places_without_a_point_are_zero(make_linear, cut):
    cut(tile=5)
    system = make_linear().system()

    taken = at_places(Elimination(system, 0.0), torch.ones(36, dtype=torch.float64))

    assert not system.eliminated_gradient[taken == 0.0].any()
    assert not system.eliminated_hessian[:, taken[0] == 0.0].any()
    assert int((taken[0] == 0.0).sum()) == 3


def test_the_order_of_the_observations_does_not_matter(make_linear, generator):
    linear = make_linear(families=[(2, 2)], extra=2)
    shuffled = linear.where(torch.randperm(45, generator=generator))

    one, other = linear.system(), shuffled.system()

    assert torch.equal(one.rows, other.rows)
    assert torch.equal(one.dense(), other.dense())
    assert torch.equal(one.eliminated_hessian, other.eliminated_hessian)


def test_the_cost_is_handed_through(make_linear):
    linear = make_linear(extra=1)
    _, residual = linear.rows()

    assert_matches(linear.system().cost, 0.5 * residual.square().sum())


def test_blocks_of_rows_hold_the_products_of_the_derivatives(draw):
    columns, jacobian, residual = torch.arange(12).view(4, 3), draw.normal(4, 5, 3), draw.normal(4, 5)

    blocks = Blocks.of_rows(columns, jacobian, residual)

    assert blocks.columns is columns
    assert_matches(blocks.hessian, torch.einsum("kri,krj->kij", jacobian, jacobian))
    assert_matches(blocks.gradient, torch.einsum("kri,kr->ki", jacobian, residual))


@pytest.mark.parametrize(("count", "size"), [(0, 4), (3, 4), (4, 4), (9, 4)])
def test_slices_in_the_cache_follow_each_other_and_are_never_longer(count, size):
    slices = in_cache(count, size)

    assert [i for part in slices for i in range(count)[part]] == list(range(count))
    assert all(0 < part.stop - part.start <= size for part in slices)
