"""Points lifted to where they appear to be."""

import pytest
import torch

from tests.tolerances import DTYPES, assert_matches
from torchrefrac.geometry import Plane, triples
from torchrefrac.refraction import FlatInterface, lift_points, solve_refrax
from torchrefrac.refraction.lift import is_valid, look, solve_height_with_partials

WATER = FlatInterface(torch.tensor(1.333, dtype=torch.float64))
AIR = FlatInterface(torch.tensor(1.0, dtype=torch.float64))


def test_a_point_under_water_appears_at_its_own_place_but_lifted_by_the_refrax_ratio(draw):
    center, points = _scene(draw, 200)
    points[:, 2] = -points[:, 2].abs()

    offset, valid = lift_points(center, points, WATER)

    straight = points - center
    ratio = solve_refrax(center[:, 2], -points[:, 2], torch.hypot(straight[:, 0], straight[:, 1]), 1.333)
    assert valid.all()
    assert torch.equal(offset[:, :2], straight[:, :2])
    assert_matches(offset[:, 2], -center[:, 2] / ratio)


def test_a_point_on_land_is_seen_where_it_is(draw):
    center, points = _scene(draw, 200)
    points[:, 2] = points[:, 2].abs()
    points[0, 2] = 0.0

    offset, valid = lift_points(center, points, WATER)

    assert valid.all()
    assert torch.equal(offset, points - center)


@pytest.mark.parametrize("dtype", DTYPES)
def test_at_index_ratio_one_every_offset_is_straight_to_the_last_bit(draw, dtype):
    center, points = (value.to(dtype) for value in _scene(draw, 200))
    center[::2, 2] *= -1.0  # no water, so a centre below z = 0 is as good as any

    offset, valid = lift_points(center, points, AIR.to(dtype=dtype))

    assert valid.all()
    assert torch.equal(offset, points - center)


def test_the_offset_is_continuous_across_the_waterline(draw):
    center, points = _scene(draw, 200)
    above, below = points.clone(), points.clone()
    above[:, 2], below[:, 2] = 1e-12, -1e-12

    jump = lift_points(center, above, WATER)[0] - lift_points(center, below, WATER)[0]

    assert jump.abs().max() < 1e-11


def test_a_centre_below_the_water_is_masked_and_gets_the_straight_offset(draw):
    center, points = _scene(draw, 200)
    center[:, 2] *= -1.0

    offset, valid = lift_points(center, points, WATER)

    assert not valid.any()
    assert torch.equal(offset, points - center)


def test_centres_points_and_index_ratios_broadcast(draw):
    center, points = _scene(draw, 6)
    index = draw.uniform(1.1, 1.5, 2, 1, 1)

    offset, valid = lift_points(center[:3, None], points, FlatInterface(index))

    assert offset.shape == (2, 3, 6, 3)
    assert valid.shape == (2, 3, 6)
    assert_matches(offset[1, 2, 4], lift_points(center[2], points[4], FlatInterface(index[1, 0, 0]))[0])


def test_at_index_ratio_one_every_offset_is_straight_to_rounding_behind_a_tilted_plane(draw):
    center, points = _scene(draw, 200)
    plane = Plane((0.3, -0.2, 1.0), 0.4)

    offset, valid = lift_points(center, points, FlatInterface(AIR.index_ratio, plane=plane))

    assert valid.all()
    assert_matches(offset, points - center)


def test_what_does_not_refract_is_spread_over_the_batch_of_its_plane_too(draw):
    center, points, plane = draw.normal(4, 3), draw.normal(4, 3), Plane(draw.normal(5, 1, 3))

    offset, valid = lift_points(center, points, FlatInterface(1.0, plane=plane))

    assert torch.equal(offset, (points - center).expand(5, 4, 3))
    assert valid.shape == (5, 4)
    assert valid.all()


def test_a_long_batch_is_lifted_as_each_of_its_points(draw):
    center, points = _scene(draw, 70_000)
    index = draw.uniform(1.2, 1.4, 2, 1)

    offset, valid = lift_points(center[:2, None], points, FlatInterface(index))

    few = slice(None, None, 7_000)
    alone, _ = lift_points(center[:2, None], points[few], FlatInterface(index))
    assert offset.shape == (2, 70_000, 3)
    assert valid.all()
    assert_matches(offset[:, few], alone)


def test_the_closed_form_partials_are_those_of_autograd_in_water_on_land_at_nadir_and_without_water(draw):
    center, points = _scene(draw, 200)
    points[:20, :2] = center[:20, :2]
    center[20:30, 2] *= -1.0
    index = torch.where(torch.arange(200) % 5 == 0, 1.0, draw.uniform(1.01, 2.5, 200))
    for value in (center, points, index):
        value.requires_grad_()
    interface = FlatInterface(index)
    offset, valid = lift_points(center, points, interface)
    by_center, by_point, by_index = torch.autograd.grad(-offset[:, 2].sum(), (center, points, index))

    sight = look(triples.split(center), triples.split(points), interface.parameters(points))
    lift = solve_height_with_partials(sight, interface.camera_in_rarest)

    by_horizontal = 2.0 * lift.by_distance_sq[:, None] * (points - center)[:, :2]
    assert torch.equal(lift.height, -offset[:, 2])
    assert torch.equal(is_valid(sight, lift.height), valid)
    assert_matches(lift.by_height, by_center[:, 2])
    assert_matches(-lift.by_depth, by_point[:, 2])
    assert_matches(by_horizontal, by_point[:, :2])
    assert_matches(-by_horizontal, by_center[:, :2])
    assert_matches(lift.by_index[0], by_index)


def _scene(draw, count):
    """Centres one to three above the water; points within three around them, half of them under water."""
    center = torch.cat((draw.uniform(-1.0, 1.0, count, 2), draw.uniform(1.0, 3.0, count, 1)), dim=-1)
    points = torch.cat((draw.uniform(-3.0, 3.0, count, 2), draw.uniform(-0.9, 0.9, count, 1)), dim=-1)
    return center, points
