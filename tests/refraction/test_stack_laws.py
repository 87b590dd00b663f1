"""The laws of refraction through several layers."""

import math

import pytest
import torch
from torch.nn.functional import normalize

from tests.refraction.interfaces import (
    INTERFACES,
    WALL,
    at_depth,
    cameras_before,
    depth_of_borders,
    points_behind,
    points_within,
    through_every_interface,
)
from tests.tolerances import DTYPES, EXACT, assert_matches
from torchrefrac.geometry import Plane, rotate
from torchrefrac.refraction import FlatInterface, lift_points, refract_rays

COUNT = 100


@through_every_interface
def test_the_ray_cast_along_the_offset_passes_through_the_point(draw, interface):
    center, points = cameras_before(draw, interface, COUNT), points_behind(draw, interface, COUNT)

    offset, seen = lift_points(center, points, interface)
    origin, direction, cast = refract_rays(center, offset, interface)

    along = ((points - origin) * direction).sum(dim=-1, keepdim=True)
    assert seen.all()
    assert cast.all()
    assert (along > 0.0).all()
    assert_matches(origin + along * direction, points, slack=10.0)


@through_every_interface
def test_an_independent_ray_trace_meets_what_is_seen(draw, interface):
    center, surfaces = cameras_before(draw, interface, COUNT), depth_of_borders(interface)
    direction = _towards(draw, interface, torch.rad2deg(_critical_angle(interface)) - 1.0)

    origin, onward = _trace(center, direction, interface, surfaces)
    points = origin + draw.uniform(0.1, 2.0, COUNT, 1) * onward

    assert_matches(normalize(lift_points(center, points, interface)[0], dim=-1), direction, slack=100.0)
    cast_origin, cast_direction, valid = refract_rays(center, direction, interface)
    assert valid.all()
    assert_matches(cast_origin, origin, slack=100.0)
    assert_matches(cast_direction, onward, slack=100.0)


@through_every_interface
def test_a_point_in_an_inner_layer_is_seen_as_if_that_layer_had_no_end(draw, interface):
    borders = [*depth_of_borders(interface).tolist(), 3.0]
    for layer in range(1, len(borders)):
        center = cameras_before(draw, interface, COUNT)
        points = at_depth(draw, interface, draw.uniform(borders[layer - 1], borders[layer], COUNT))
        endless = FlatInterface(
            layers=interface.indices[: layer + 1], thickness=interface.thickness[: layer - 1], plane=interface.plane
        )

        offset, valid = lift_points(center, points, interface)

        assert valid.all()
        assert_matches(offset, lift_points(center, points, endless)[0], slack=10.0)


@through_every_interface
def test_the_way_back_is_the_same_ray(draw, interface):
    center, points = cameras_before(draw, interface, COUNT), points_behind(draw, interface, COUNT)
    flipped = Plane(
        tuple(-n for n in interface.plane.normal), float(depth_of_borders(interface)[-1]) - interface.plane.offset
    )
    back = FlatInterface(layers=interface.indices[::-1], thickness=interface.thickness[::-1], plane=flipped)

    offset, _ = lift_points(center, points, interface)
    offset_back, valid = lift_points(points, center, back)

    assert valid.all()
    assert_matches(normalize(offset_back, dim=-1), -refract_rays(center, offset, interface)[1], slack=10.0)
    assert_matches(normalize(offset, dim=-1), -refract_rays(points, offset_back, back)[1], slack=10.0)


@through_every_interface
def test_what_turns_and_moves_together_is_seen_in_the_turned_direction(draw, interface):
    center, points = cameras_before(draw, interface, COUNT), points_within(draw, interface, COUNT)
    turn, origin = draw.rotations(COUNT), draw.normal(COUNT, 3)
    moved = FlatInterface(
        layers=interface.indices, thickness=interface.thickness, plane=interface.plane.in_frame(turn, origin)
    )

    offset, valid = lift_points(rotate(turn, center - origin), rotate(turn, points - origin), moved)

    assert valid.all()
    assert_matches(offset, rotate(turn, lift_points(center, points, interface)[0]), slack=10.0)


@through_every_interface
def test_the_offset_is_continuous_across_every_surface_inside_the_critical_cone(draw, interface):
    for i, border in enumerate(depth_of_borders(interface).tolist()):
        lateral = 1.0 if interface.indices[i + 1] >= min(interface.indices[: i + 1]) else 0.05
        center = cameras_before(draw, interface, COUNT, lateral)
        point = at_depth(draw, interface, torch.full((COUNT,), border, dtype=torch.float64), lateral)
        step = 1e-10 * interface.plane.normal_like(point)

        jump = lift_points(center, point + step, interface)[0] - lift_points(center, point - step, interface)[0]

        assert jump.abs().max() < 1e-8


@pytest.mark.parametrize("layers", [(1.333, 1.0), (1.333, 1.52, 1.0), (1.333, 1.52, 1.0, 1.2)], ids=str)
def test_from_under_water_the_world_is_seen_within_the_critical_cone(draw, layers):
    interface = FlatInterface(layers=layers, thickness=(0.1,) * (len(layers) - 2), plane=WALL)
    center = cameras_before(draw, interface, COUNT)
    points = at_depth(
        draw, interface, depth_of_borders(interface)[-1] + draw.power_of_ten(-6.0, 1.0, COUNT), lateral=100.0
    )

    offset, valid = lift_points(center, points, interface)

    sine_sq = 1.0 - (normalize(offset, dim=-1) @ WALL.normal_like(offset)).square()
    assert valid.all()
    assert sine_sq.max() < 1.333**-2 * (1.0 + EXACT.rounding)
    assert sine_sq.max() > 0.999 * 1.333**-2


@through_every_interface
def test_only_the_ratios_of_the_indices_matter(draw, interface):
    center, points = cameras_before(draw, interface, COUNT), points_within(draw, interface, COUNT)

    for factor in (2.0, 1.7):
        index = tuple(factor * n for n in interface.indices)
        scaled = FlatInterface(layers=index, thickness=interface.thickness, plane=interface.plane)
        assert_matches(lift_points(center, points, scaled)[0], lift_points(center, points, interface)[0], slack=10.0)


@through_every_interface
def test_the_unit_of_length_does_not_matter(draw, interface):
    center, points = cameras_before(draw, interface, COUNT), points_within(draw, interface, COUNT)
    plane = Plane(interface.plane.normal, 1e3 * interface.plane.offset)
    thickness = tuple(1e3 * d for d in interface.thickness)

    in_other_unit = FlatInterface(layers=interface.indices, thickness=thickness, plane=plane)

    expected = 1e3 * lift_points(center, points, interface)[0]
    assert_matches(lift_points(1e3 * center, 1e3 * points, in_other_unit)[0], expected, slack=1e4)


@through_every_interface
def test_a_layer_cut_in_two_is_the_same_layer(draw, interface):
    center, points = cameras_before(draw, interface, COUNT), points_within(draw, interface, COUNT)
    expected, _ = lift_points(center, points, interface)

    for i in range(1, len(interface.indices)):
        layers = (*interface.indices[: i + 1], *interface.indices[i:])
        if i <= len(interface.thickness):
            d = interface.thickness[i - 1]
            thickness = (*interface.thickness[: i - 1], 0.3 * d, 0.7 * d, *interface.thickness[i:])
        else:
            thickness = (*interface.thickness, 0.3)
        cut = FlatInterface(layers=layers, thickness=thickness, plane=interface.plane)
        assert_matches(lift_points(center, points, cut)[0], expected, slack=10.0)


@through_every_interface
def test_a_layer_without_thickness_is_not_there(draw, interface):
    center, points = cameras_before(draw, interface, COUNT), points_within(draw, interface, COUNT)
    expected, _ = lift_points(center, points, interface)

    for i in range(1, len(interface.indices)):
        layers = (*interface.indices[:i], 1.9, *interface.indices[i:])
        thickness = (*interface.thickness[: i - 1], 0.0, *interface.thickness[i - 1 :])
        more = FlatInterface(layers=layers, thickness=thickness, plane=interface.plane)
        assert_matches(lift_points(center, points, more)[0], expected, slack=10.0)


def test_glass_without_thickness_is_bare_water(draw):
    glass, bare = FlatInterface.glass_wall(WALL, 0.0), FlatInterface(1.333, plane=WALL)
    center, points = cameras_before(draw, bare, COUNT), points_behind(draw, bare, COUNT)

    offset, _ = lift_points(center, points, glass)

    assert_matches(offset, lift_points(center, points, bare)[0])
    for through_glass, through_water in zip(
        refract_rays(center, offset, glass), refract_rays(center, offset, bare), strict=True
    ):
        torch.testing.assert_close(through_glass, through_water, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("index", [1.0, 1.333])
def test_layers_of_one_index_are_looked_through_straight(draw, index, dtype):
    layers = torch.full((4,), index, dtype=dtype)
    interface = FlatInterface(layers=layers, thickness=(0.1, 0.2), plane=WALL)
    center = cameras_before(draw, interface, COUNT).to(dtype)
    points = points_within(draw, interface, COUNT).to(dtype)

    offset, valid = lift_points(center, points, interface)
    _, direction, met = refract_rays(center, points - center, interface)

    assert valid.all()
    assert met.all()
    assert_matches(offset, points - center)
    assert_matches(direction, normalize(points - center, dim=-1))


@pytest.mark.parametrize("dtype", DTYPES)
def test_layers_of_one_index_behind_an_upright_plane_are_straight_to_the_last_bit(draw, dtype):
    interface = FlatInterface(layers=torch.full((4,), 1.333, dtype=dtype), thickness=(0.1, 0.2))
    center = cameras_before(draw, interface, COUNT).to(dtype)
    points = points_within(draw, interface, COUNT).to(dtype)

    offset, _ = lift_points(center, points, interface)

    assert torch.equal(offset, points - center)


def test_a_slab_shifts_a_ray_sideways_by_the_textbook_displacement_and_does_not_turn_it(draw):
    slab, d, n = INTERFACES["slab"], 0.3, 1.333
    center, direction = cameras_before(draw, slab, COUNT), _towards(draw, slab, 85.0)

    origin, onward, valid = refract_rays(center, direction, slab)

    cosine = -(direction @ slab.plane.normal_like(direction))
    sine_sq = 1.0 - cosine.square()
    displacement = d * sine_sq.sqrt() * (1.0 - cosine / (n**2 - sine_sq).sqrt())
    moved = origin - center
    sideways = moved - (moved * direction).sum(dim=-1, keepdim=True) * direction
    assert valid.all()
    assert_matches(onward, direction)
    assert_matches(sideways.norm(dim=-1), displacement, slack=10.0)


@pytest.mark.parametrize(
    "layers", [(1.333, 1.0), (1.333, 1.52, 1.0), (1.333, 1.0, 1.333), (1.333, 1.0, 1.9, 1.2)], ids=str
)
def test_a_ray_beyond_the_critical_angle_is_masked_and_returned_as_it_came(draw, layers):
    interface = FlatInterface(layers=layers, thickness=(0.1,) * (len(layers) - 2), plane=WALL)
    critical = math.asin(1.0 / 1.333)
    angle = torch.tensor([0.0, 0.3, critical - 1e-9, critical + 1e-9, 1.0, 1.57], dtype=torch.float64)
    first, _ = WALL.tangents_like(angle)
    direction = angle.sin()[:, None] * first - angle.cos()[:, None] * WALL.normal_like(angle)
    center = cameras_before(draw, interface, 6)

    origin, onward, valid = refract_rays(center, 3.0 * direction, interface)

    assert valid.tolist() == [True, True, True, False, False, False]
    assert torch.equal(origin[3:], center[3:])
    assert_matches(onward[3:], direction[3:])
    assert onward.isfinite().all()
    assert origin.isfinite().all()


@through_every_interface
def test_before_the_first_surface_everything_is_seen_straight(draw, interface):
    center, points = cameras_before(draw, interface, COUNT), at_depth(draw, interface, -draw.uniform(0.0, 3.0, COUNT))

    offset, valid = lift_points(center, points, interface)

    assert valid.all()
    assert_matches(offset, points - center)


@through_every_interface
def test_a_centre_behind_the_first_surface_is_masked_and_sees_straight(draw, interface):
    center, points = points_within(draw, interface, COUNT), points_behind(draw, interface, COUNT)

    offset, seen = lift_points(center, points, interface)
    origin, direction, cast = refract_rays(center, points - center, interface)

    assert not seen.any()
    assert not cast.any()
    assert_matches(offset, points - center)
    assert torch.equal(origin, center)
    assert_matches(direction, normalize(points - center, dim=-1))


@pytest.mark.parametrize("name", ["water", "glass wall", "air gap", "oil on water in a glass"])
def test_single_precision_sees_the_same(draw, name):
    interface = INTERFACES[name]
    center, points = cameras_before(draw, interface, COUNT), points_within(draw, interface, COUNT)

    offset, valid = lift_points(center.float(), points.float(), interface)

    assert valid.all()
    assert_matches(offset, lift_points(center, points, interface)[0].float())


def test_a_batch_of_interfaces_is_each_of_them(draw):
    index, thickness = draw.uniform(1.0, 1.6, 3, 4), draw.uniform(0.05, 0.3, 2, 1)
    plane = Plane(draw.normal(2, 4, 3), draw.normal(4))
    interface = FlatInterface(layers=tuple(index), thickness=(thickness,), plane=plane)
    normal = plane.normal_like(index)
    center, points = normal * (plane.offset + 1.0)[:, None], normal * (plane.offset - 1.0)[:, None] + 0.5

    offset, valid = lift_points(center, points, interface)

    one = FlatInterface(
        layers=tuple(index[:, 2]), thickness=(thickness[1, 0],), plane=Plane(normal[1, 2], plane.offset[2])
    )
    assert offset.shape == (2, 4, 3)
    assert valid.shape == (2, 4)
    assert_matches(offset[1, 2], lift_points(center[1, 2], points[1, 2], one)[0])


def _towards(draw, interface, steepest_deg):
    """Unit directions (COUNT, 3) at up to that angle from the vertical of the interface."""
    angle = torch.deg2rad(draw.uniform(0.0, 1.0, COUNT) * steepest_deg)
    azimuth = draw.uniform(-math.pi, math.pi, COUNT)
    first, second = interface.plane.tangents_like(angle)
    side = azimuth.cos()[:, None] * first + azimuth.sin()[:, None] * second
    return angle.sin()[:, None] * side - angle.cos()[:, None] * interface.plane.normal_like(angle)


def _critical_angle(interface):
    """Largest angle in the camera's medium that passes every layer."""
    return torch.tensor(min(interface.indices) / interface.indices[0], dtype=torch.float64).asin()


def _trace(origin, direction, interface, surfaces):
    """From surface to surface by Snell's law in vector form: where the ray enters the last medium, and how."""
    normal, index = interface.plane.normal_like(origin), interface.indices
    for depth, before, after in zip(surfaces.tolist(), index[:-1], index[1:], strict=True):
        cosine = -(direction @ normal)[:, None]
        origin = origin + ((origin @ normal)[:, None] - (interface.plane.offset - depth)) / cosine * direction
        r = before / after
        direction = r * direction + (r * cosine - (1.0 - r**2 * (1.0 - cosine**2)).sqrt()) * normal
    return origin, direction
