"""Derivatives through several layers: in the camera, the point, every index and thickness, and the plane."""

import pytest
import torch

from tests.refraction.interfaces import (
    INTERFACES,
    cameras_before,
    depth_of_borders,
    points_behind,
    points_within,
    through_every_interface,
)
from tests.tolerances import assert_matches
from torchrefrac.geometry import Plane, triples
from torchrefrac.refraction import FlatInterface, apparent_height, apparent_height_partials, lift_points, refract_rays
from torchrefrac.refraction.lift import look, solve_height, solve_height_with_partials

# squared distance, way through the rarest medium; thickness and index of each other layer
STACKS = {
    "two denser layers": ((3.0, 0.8), (0.2, 1.1), (1.5, 1.3)),
    "nadir": ((0.0, 0.8), (0.2, 1.1), (1.5, 1.3)),
    "grazing": ((4000.0, 0.8), (0.2, 1.1), (1.5, 1.3)),
    "three layers, one without thickness": ((3.0, 0.5), (0.2, 0.0, 1.1), (1.2, 1.5, 2.5)),
    "indices that are nearly that of the rarest": ((3.0, 0.5), (0.2, 0.3, 1.1), (1.0001, 1.001, 1.333)),
}
through_every_stack = pytest.mark.parametrize("stack", STACKS.values(), ids=STACKS.keys())
FEW = ["glass wall", "looking out through glass", "air gap", "oil on water in a glass"]


@through_every_stack
@pytest.mark.parametrize("method", ["halley", "newton"])
def test_apparent_height_behind_layers_has_the_right_first_derivatives(stack, method):
    inputs = _tensors(stack)

    assert torch.autograd.gradcheck(lambda *x: _height(*x, method=method), inputs, check_forward_ad=True)


@through_every_stack
def test_apparent_height_behind_layers_has_the_right_second_derivatives(stack):
    assert torch.autograd.gradgradcheck(_height, _tensors(stack))


@through_every_stack
def test_partials_in_closed_form_behind_layers_are_those_of_autograd(stack):
    inputs = distance_sq, clear, *layers = _tensors(stack)
    apparent, half = _height(*inputs), len(layers) // 2

    partials = apparent_height_partials(apparent, distance_sq, clear, layers[:half], layers[half:])

    in_closed_form = (partials.by_distance_sq, partials.by_clear, *partials.by_thickness, *partials.by_index)
    for partial, gradient in zip(in_closed_form, torch.autograd.grad(apparent, inputs), strict=True):
        assert_matches(partial, gradient)


@pytest.mark.parametrize("name", FEW)
@pytest.mark.parametrize("behind", [points_behind, points_within], ids=["in the last medium", "in any layer"])
def test_the_offset_is_differentiable_in_camera_point_index_thickness_and_plane(draw, name, behind):
    interface = INTERFACES[name]
    inputs = _parameters(interface, cameras_before(draw, interface, 1), behind(draw, interface, 1))

    assert torch.autograd.gradcheck(_offset, inputs, check_forward_ad=True)


@pytest.mark.parametrize("name", FEW)
def test_the_offset_is_twice_differentiable_in_camera_point_index_thickness_and_plane(draw, name):
    interface = INTERFACES[name]
    inputs = _parameters(interface, cameras_before(draw, interface, 1), points_behind(draw, interface, 1))

    assert torch.autograd.gradgradcheck(_offset, inputs)


@pytest.mark.parametrize("name", FEW)
def test_cast_rays_are_differentiable_in_camera_direction_index_thickness_and_plane(draw, name):
    interface = INTERFACES[name]
    center = cameras_before(draw, interface, 1)
    offset, _ = lift_points(center, points_behind(draw, interface, 1), interface)

    def cast(center, direction, *others):
        return refract_rays(center, direction, _interface(*others))[:2]

    assert torch.autograd.gradcheck(cast, _parameters(interface, center, offset), check_forward_ad=True)


@through_every_interface
def test_closed_form_derivatives_of_the_apparent_height_are_those_of_autograd(draw, interface):
    center, points = cameras_before(draw, interface, 50), points_within(draw, interface, 50)
    center, points, index, *others = _parameters(interface, center, points)
    sight = look(triples.split(center), triples.split(points), _interface(index, *others).parameters(points))
    height = solve_height(sight, interface.camera_in_rarest)
    by_center, by_point, by_index = torch.autograd.grad(height.sum(), (center, points, index))

    lift = solve_height_with_partials(sight, interface.camera_in_rarest)

    n = interface.plane.normal_like(points)
    aside = 2.0 * lift.by_distance_sq[:, None] * torch.stack(sight.horizontal, dim=-1)
    assert_matches(lift.height, height)
    assert_matches(lift.by_height[:, None] * n - aside, by_center, slack=10.0)
    assert_matches(aside - lift.by_depth[:, None] * n, by_point, slack=10.0)
    by_ratio = torch.stack([by.sum() for by in lift.by_index])
    assert_matches(by_ratio / index[0], by_index[1:], slack=100.0)
    assert_matches(-(by_ratio * index[1:]).sum() / index[0] ** 2, by_index[0], slack=100.0)


@through_every_interface
def test_whether_the_camera_is_known_to_be_in_the_rarest_medium_changes_nothing(draw, interface):
    center, points = cameras_before(draw, interface, 50), points_within(draw, interface, 50)
    known, unknown = interface, _interface(*_parameters(interface, center, points)[2:])

    lifts = []
    for each in (known, unknown):
        sight = look(triples.split(center), triples.split(points), each.parameters(points))
        lifts.append(solve_height_with_partials(sight, each.camera_in_rarest))

    assert not unknown.camera_in_rarest
    for value, expected in zip(lifts[1][:4], lifts[0][:4], strict=True):
        assert_matches(value, expected, slack=10.0)
    for value, expected in zip(lifts[1].by_index, lifts[0].by_index, strict=True):
        assert_matches(value, expected, slack=10.0)


@pytest.mark.parametrize("layered", [False, True], ids=["one surface", "layers of one index"])
def test_the_gradient_in_the_index_survives_where_nothing_is_refracted_yet(layered):
    center, point = torch.tensor([[0.0, 0.0, 1.0], [2.0, 0.5, -1.5]], dtype=torch.float64)

    def height(index):
        layers = (1.0, 1.0, index) if layered else (1.0, index)
        interface = FlatInterface(layers=layers, thickness=(0.2,) * layered)
        return -lift_points(center, point, interface)[0][2]

    index, step = torch.tensor(1.0, dtype=torch.float64, requires_grad=True), 1e-5
    (gradient,) = torch.autograd.grad(height(index), index)

    f0, f1, f2 = (height(torch.tensor(1.0 + k * step, dtype=torch.float64)) for k in range(3))
    torch.testing.assert_close(gradient, (-3.0 * f0 + 4.0 * f1 - f2) / (2.0 * step), rtol=1e-6, atol=0.0)
    assert gradient < -0.1


def test_an_index_below_the_cameras_has_the_same_slope_as_one_above():
    center, point = torch.tensor([[0.0, 0.0, 1.0], [2.0, 0.5, -1.5]], dtype=torch.float64)

    def height(index):
        return -lift_points(center, point, FlatInterface(layers=(1.2, index)))[0][2]

    index, step = torch.tensor(1.2, dtype=torch.float64, requires_grad=True), 1e-5
    (gradient,) = torch.autograd.grad(height(index), index)

    rarer, denser = (height(torch.tensor(1.2 + k * step, dtype=torch.float64)) for k in (-1, 1))
    torch.testing.assert_close(gradient, (denser - rarer) / (2.0 * step), rtol=1e-7, atol=0.0)


@pytest.mark.parametrize("name", FEW)
def test_on_an_inner_surface_the_derivative_is_the_slope_on_one_of_its_sides(name):
    interface, border = INTERFACES[name], float(depth_of_borders(INTERFACES[name])[1])
    upright = FlatInterface(layers=interface.indices, thickness=interface.thickness)
    center = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)

    def slope(depth):
        point = torch.tensor([0.3, 0.0, -depth], dtype=torch.float64, requires_grad=True)
        return -torch.autograd.grad(-lift_points(center, point, upright)[0][2], point)[0][2]

    on_it = slope(border)

    one_side, other_side = slope(border - 1e-9), slope(border + 1e-9)
    assert min(abs(on_it - one_side), abs(on_it - other_side)) < 1e-6


def test_the_height_of_the_water_is_the_height_of_the_camera_the_other_way_round(draw):
    center, points = cameras_before(draw, INTERFACES["water"], 50), points_behind(draw, INTERFACES["water"], 50)
    center.requires_grad_()
    points.requires_grad_()
    offset = torch.tensor(0.0, dtype=torch.float64, requires_grad=True)

    seen, _ = lift_points(center, points, FlatInterface(1.333, plane=Plane(offset=offset)))
    by_center, by_point, by_offset = torch.autograd.grad(seen[:, 2].sum(), (center, points, offset))

    assert_matches(by_offset, -by_center[:, 2].sum() - by_point[:, 2].sum(), slack=10.0)


def _height(distance_sq, clear, *layers, method="halley"):
    half = len(layers) // 2
    return apparent_height(distance_sq, clear, layers[:half], layers[half:], method)


def _tensors(stack):
    values = [value for part in stack for value in part]
    return [torch.tensor(value, dtype=torch.float64, requires_grad=True) for value in values]


def _parameters(interface, center, points):
    """Everything that can be differentiated: centre, points, indices, thickness, normal, offset.

    The indices are those of the interface times 1.1, so that none is at the border of what is allowed.
    """
    indices = tuple(1.1 * n for n in interface.indices)
    others = (indices, interface.thickness, interface.plane.normal, interface.plane.offset)
    values = (center, points, *(torch.tensor(value, dtype=torch.float64) for value in others))
    return [value.clone().requires_grad_() for value in values]


def _interface(index, thickness, normal, offset):
    return FlatInterface(layers=index, thickness=thickness, plane=Plane(normal, offset))


def _offset(center, points, *others):
    return lift_points(center, points, _interface(*others))[0]
