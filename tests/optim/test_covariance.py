"""Covariances against the inverse of the whole matrix, bordered by inner constraints where there is a gauge."""

from dataclasses import replace

import pytest
import torch

from tests.optim.linear_problems import with_gauge
from torchrefrac.optim import Covariance, NormalEquations, SingularError, covariance

SHAPES = [
    {},
    {"families": [(3, 2)]},
    {"families": [(1, 2), (2, 1)], "extra": 4},
    {"extra": 3},
    {"points": 150, "pairs": 500, "families": [(2, 2)]},
    {"cameras": 9, "points": 90, "pairs": 350},
]
PORTIONS = [(64, 1 << 19), (5, 1 << 19), (4, 2 * 4 * 3 * 6 * 4), (1, 1)]
shapes = pytest.mark.parametrize("shape", SHAPES, ids=str)


@pytest.fixture(params=PORTIONS, ids=lambda portion: f"tile{portion[0]}-elements{portion[1]}")
def portions(request, cut):
    cut(*request.param, cached=11)
    return request.param


def close(actual, expected):
    torch.testing.assert_close(actual, expected, rtol=1e-7, atol=1e-9 * float(expected.abs().max()))


def bordered_inverse(linear, constraint=None):
    """Of [H C; C^T 0], the block (size + 3 n, size + 3 n): the covariance of least trace under C^T kept = 0. Zero for
    what nothing depends on."""
    hessian, _ = linear.dense()
    alive = (hessian.diagonal() > 1e-18).nonzero()[:, 0]
    border = hessian.new_zeros(len(hessian), 0 if constraint is None else constraint.shape[1])
    border[: linear.size] = 0.0 if constraint is None else constraint
    count = border.shape[1]
    upper = torch.cat((hessian[alive][:, alive], border[alive]), dim=1)
    lower = torch.cat((border[alive].T, hessian.new_zeros(count, count)), dim=1)
    inverse = torch.zeros_like(hessian)
    inverse[alive[:, None], alive] = torch.linalg.inv(torch.cat((upper, lower)))[: len(alive), : len(alive)]
    return inverse


def blocks_of_eliminated(linear, inverse):
    """(n, 3, 3) of (size + 3 n, size + 3 n)."""
    own = inverse[linear.size :, linear.size :].unflatten(0, (-1, 3)).unflatten(2, (-1, 3))
    return own.diagonal(dim1=0, dim2=2).permute(2, 0, 1)


def often_seen(linear, at_least=2):
    """The same without the points that fewer cameras see."""
    seen = torch.bincount(linear.point, minlength=linear.num_eliminated) >= at_least
    where = linear.where(seen[linear.point])
    return replace(where, point=(torch.cumsum(seen, dim=0) - 1)[where.point], num_eliminated=int(seen.sum()))


@shapes
def test_it_is_the_inverse_of_the_whole_matrix_block_by_block(make_linear, portions, shape):
    linear = often_seen(make_linear(**shape))

    found = Covariance.of(linear.system())

    inverse = bordered_inverse(linear)
    close(found.reduced, inverse[: linear.size, : linear.size])
    close(found.eliminated(), blocks_of_eliminated(linear, inverse))


@shapes
def test_a_gauge_is_fixed_by_inner_constraints_on_what_is_kept(make_linear, portions, draw, shape):
    linear, null_space = with_gauge(often_seen(make_linear(**{**shape, "extra": 0})), draw)

    found = Covariance.of(linear.system(null_space))

    inverse = bordered_inverse(linear, null_space)
    close(found.reduced, inverse[: linear.size, : linear.size])
    close(found.eliminated(), blocks_of_eliminated(linear, inverse))


def test_along_the_gauge_there_is_no_variance_and_no_other_choice_of_it_has_a_smaller_trace(make_linear, draw):
    linear, null_space = with_gauge(often_seen(make_linear(families=[(2, 1)])), draw)

    kept = Covariance.of(linear.system(null_space)).reduced

    assert (kept @ null_space).abs().max() < 1e-10 * kept.abs().max()
    for _ in range(5):
        other = torch.linalg.qr(null_space + 0.3 * draw.normal(*null_space.shape)).Q
        assert bordered_inverse(linear, other)[: linear.size, : linear.size].trace() > kept.trace()


def test_the_directions_that_span_the_gauge_do_not_matter(make_linear, draw):
    linear, null_space = with_gauge(often_seen(make_linear()), draw)
    turn = torch.linalg.qr(draw.normal(4, 4)).Q

    found, turned = (Covariance.of(linear.system(basis)) for basis in (null_space, null_space @ turn))

    close(turned.reduced, found.reduced)
    close(turned.eliminated(), found.eliminated())


def test_the_tiles_in_which_points_lie_do_not_matter(make_linear, cut):
    cut(tile=4)
    linear = often_seen(make_linear(points=40, pairs=150))
    shuffled = torch.arange(linear.num_eliminated).roll(17) * 7919 % linear.num_eliminated

    found, other = (Covariance.of(linear.system(locality=locality)) for locality in (None, shuffled))

    close(other.reduced, found.reduced)
    close(other.eliminated(), found.eliminated())


def test_what_nothing_depends_on_has_no_variance_and_what_else_there_is_has_its_own(make_linear, draw):
    """A camera without observations, and an unknown to which no observation reacts."""
    linear = make_linear(families=[(3, 1)])
    linear = often_seen(linear.where(linear.camera != 2))
    by_reduced = linear.by_reduced.clone()
    by_reduced[..., 7] = 0.0
    linear = replace(linear, by_reduced=by_reduced)

    found = Covariance.of(linear.system())

    dead = torch.zeros(linear.size, dtype=torch.bool)
    dead[12:18] = dead[-2] = True
    assert (found.reduced[dead] == 0.0).all()
    assert (found.reduced[:, dead] == 0.0).all()
    inverse = bordered_inverse(linear)
    close(found.reduced, inverse[: linear.size, : linear.size])
    close(found.eliminated(), blocks_of_eliminated(linear, inverse))


def test_a_gauge_that_also_moves_a_camera_without_observations_is_that_of_the_others(make_linear, draw):
    linear, null_space = with_gauge(often_seen(make_linear()), draw)
    linear = often_seen(linear.where(linear.camera != 2))
    others = null_space.clone()
    others[12:18] = 0.0

    found = Covariance.of(linear.system(null_space))

    inverse = bordered_inverse(linear, others)
    close(found.reduced, inverse[: linear.size, : linear.size])
    close(found.eliminated(), blocks_of_eliminated(linear, inverse))


def test_of_a_point_that_nobody_sees_nothing_is_known_and_the_others_are_as_without_it(make_linear):
    linear = often_seen(make_linear())
    with_idle = replace(linear, num_eliminated=linear.num_eliminated + 2)

    found = Covariance.of(with_idle.system())

    expected = Covariance.of(linear.system())
    close(found.reduced, expected.reduced)
    close(found.eliminated()[:-2], expected.eliminated())
    assert (found.eliminated()[-2:].diagonal(dim1=1, dim2=2) > 1e100).all()


def test_it_scales_with_the_units_of_the_unknowns(make_linear, draw):
    linear = often_seen(make_linear())
    unit = draw.power_of_ten(-3.0, 3.0, 9)

    found, other = Covariance.of(linear.system()), Covariance.of(linear.in_units(unit).system())

    outer = unit[:, None] * unit
    torch.testing.assert_close(other.eliminated() * outer[-3:, -3:], found.eliminated(), rtol=1e-8, atol=1e-12)
    torch.testing.assert_close(other.reduced[:6, :6] * outer[:6, :6], found.reduced[:6, :6], rtol=1e-8, atol=1e-12)


@pytest.mark.parametrize("known", [0, 3])
def test_an_undetermined_direction_beyond_the_gauge_raises(make_linear, draw, known):
    for _ in range(10):  # rounding decides what a Cholesky factorisation makes of a zero
        linear, null_space = with_gauge(often_seen(make_linear()), draw)

        with pytest.raises(SingularError, match="the normal equations are singular"):
            Covariance.of(linear.system(null_space[:, :known] if known else None))


def test_more_unknowns_than_fit_raise_by_number(make_linear, monkeypatch):
    monkeypatch.setattr(covariance, "MAX_COVARIANCE", 31)

    Covariance.of(often_seen(make_linear(extra=1)).system())

    with pytest.raises(SingularError, match="there are 32 reduced unknowns, more than 31"):
        Covariance.of(often_seen(make_linear(extra=2)).system())


def test_the_system_stays_as_it_was(make_linear, draw):
    linear, null_space = with_gauge(often_seen(make_linear()), draw)
    system: NormalEquations = linear.system(null_space)
    before = system.dense().clone(), system.rows.clone(), null_space.clone()

    Covariance.of(system).eliminated()

    assert all(map(torch.equal, before, (system.dense(), system.rows, null_space)))
