"""The elimination of the points against the dense Schur complement."""

import pytest
import torch

from tests.optim.linear_problems import DenseElimination, at_places, of_eliminated
from torchrefrac.optim import Elimination

SHAPES = [
    {},
    {"families": [(2, 1)]},
    {"families": [(3, 2)]},
    {"families": [(3, 2), (1, 1), (2, 3)]},
    {"families": [(1, 2), (2, 1)], "extra": 4},
    {"extra": 3},
    {"points": 150, "pairs": 500, "families": [(2, 2)]},
    {"cameras": 9, "points": 90, "pairs": 250},
]
PORTIONS = [(64, 1 << 19), (5, 1 << 19), (4, 2 * 4 * 3 * 6 * 4), (1, 1)]
shapes = pytest.mark.parametrize("shape", SHAPES, ids=str)


@pytest.fixture(params=PORTIONS, ids=lambda portion: f"tile{portion[0]}-elements{portion[1]}")
def portions(request, cut):
    cut(*request.param, cached=11)
    return request.param


def close(actual, expected):
    torch.testing.assert_close(actual, expected, rtol=1e-9, atol=1e-9)


@shapes
@pytest.mark.parametrize("damping", [1e-3, 2.0])
def test_the_lower_triangle_of_the_reduced_system_is_the_schur_complement(make_linear, portions, shape, damping):
    linear = make_linear(**shape)
    dense = DenseElimination.of(linear, damping)

    matrix, negative = Elimination(linear.system(), damping).reduced()

    complement = dense.b - dense.e @ dense.v_inverse @ dense.e.T
    close(matrix.tril(), complement.tril())
    close(negative, dense.reduced_gradient - dense.e @ dense.v_inverse @ dense.eliminated_gradient)


def test_without_damping_the_schur_complement_is_that_of_the_hessian_itself(make_linear):
    linear = make_linear(families=[(2, 1)])
    hessian, _ = linear.dense()

    matrix, _ = Elimination(linear.system(), 0.0).reduced()

    inverse = torch.linalg.inv(hessian)[: linear.size, : linear.size]
    lower = matrix.tril()
    close((lower + lower.tril(-1).T) @ inverse, torch.eye(linear.size, dtype=torch.float64))


@shapes
def test_along_points_and_along_cameras_are_products_with_the_off_diagonal_block(make_linear, portions, draw, shape):
    linear = make_linear(**shape)
    elimination, dense = Elimination(linear.system(), 1e-3), DenseElimination.of(linear, 1e-3)
    x, y = draw.normal(linear.size), draw.normal(3 * linear.num_eliminated)

    close(of_eliminated(elimination, elimination.to_eliminated(x)), dense.e.T @ x)
    close(elimination.to_reduced(at_places(elimination, y)), dense.e @ y)


@shapes
def test_times_inverse_and_back_substitution_solve_for_the_points(make_linear, portions, draw, shape):
    linear = make_linear(**shape)
    elimination, dense = Elimination(linear.system(), 1e-3), DenseElimination.of(linear, 1e-3)
    x, y = draw.normal(linear.size), draw.normal(3 * linear.num_eliminated)
    y *= dense.v_inverse.diagonal() > 0.0

    close(of_eliminated(elimination, elimination.times_inverse(at_places(elimination, y))), dense.v_inverse @ y)
    expected = -dense.v_inverse @ (dense.eliminated_gradient + dense.e.T @ x)
    close(of_eliminated(elimination, elimination.back_substitute(x)), expected)


@shapes
def test_the_tiles_are_the_whitened_off_diagonal_block(make_linear, portions, shape):
    linear = make_linear(**shape)
    elimination = Elimination(linear.system(), 0.5)
    plan, (m, tile) = elimination.system.plan, (linear.num_reduced, portions[0])
    z = torch.zeros(plan.num_places, 3, 6 * m + 6 + plan.num_shared, dtype=torch.float64)

    for chunk, by_block, by_shared in elimination.tiles():
        here = z.view(-1, tile * 3, z.shape[-1])[chunk.tiles]
        here[..., 6 * m + 6 :] = by_shared
        blocks = by_block.unflatten(-1, (-1, 6))
        for b, cameras in enumerate(chunk.reduced.tolist()):
            for slot, camera in enumerate(cameras):
                here[b, :, 6 * camera : 6 * camera + 6] = blocks[b, :, slot]

    assert not z[..., 6 * m : 6 * m + 6].any()  # what a tile is filled up with
    columns = [*range(6 * m), *range(6 * m + 6, z.shape[-1])]
    whitened = z[plan.place_of][..., columns].flatten(0, 1)
    dense = DenseElimination.of(linear, 0.5)
    e = dense.e[: len(columns)]
    close(whitened.T @ whitened, e @ dense.v_inverse @ e.T)
    x = elimination.factor.new_zeros(linear.num_eliminated, 3, 3)
    x[:, [0, 1, 1, 2, 2, 2], [0, 0, 1, 0, 1, 2]] = elimination.factor[:, plan.place_of].T
    close(whitened, torch.block_diag(*x) @ e.T)


def test_cutting_the_work_into_portions_changes_nothing(make_linear, cut):
    linear = make_linear(points=150, pairs=500, families=[(2, 2)], extra=2)
    whole = Elimination(linear.system(), 1e-3)
    assert len(whole.system.plan.chunks) == 1
    matrix, negative = whole.reduced()

    cut(7, 3 * 7 * 3 * 6 * 5, 4, 13)
    portioned = Elimination(linear.system(), 1e-3)

    assert len(portioned.system.plan.chunks) > 3
    close(portioned.reduced()[0].tril(), matrix.tril())
    close(portioned.reduced()[1], negative)


@pytest.mark.parametrize("portion", PORTIONS, ids=str)
def test_locality_changes_nothing_but_the_order(make_linear, cut, generator, portion):
    cut(*portion)
    linear = make_linear(families=[(2, 2)], extra=2)
    locality = torch.randperm(12, generator=generator)

    one, other = (Elimination(linear.system(locality=by), 1e-3).reduced() for by in (None, locality))

    close(one[0], other[0])
    close(one[1], other[1])


def test_what_nobody_sees_gives_finite_zeros(make_linear, portions, draw):
    linear = make_linear(families=[(2, 2)])
    linear = linear.where((linear.point % 5 != 4) & (linear.camera != 3))
    elimination = Elimination(linear.system(), 0.0)

    matrix, negative = elimination.reduced()

    assert elimination.factor.isfinite().all()
    assert matrix.isfinite().all()
    for values in (matrix.tril()[18:24], matrix.tril()[:, 18:24], negative[18:24]):
        assert not values.any()
    unseen = elimination.system.plan.place_of[4::5]
    assert not elimination.back_substitute(draw.normal(linear.size))[:, unseen].any()


def test_without_observations_the_reduced_system_is_that_of_the_terms(make_linear, draw):
    linear = make_linear(extra=2)
    linear = linear.where(torch.zeros(45, dtype=torch.bool))
    hessian, gradient = linear.dense()
    elimination = Elimination(linear.system(), 0.1)

    matrix, negative = elimination.reduced()

    close(matrix.tril(), hessian[: linear.size, : linear.size].tril())
    close(negative, gradient[: linear.size])
    assert not elimination.back_substitute(draw.normal(linear.size)).any()
