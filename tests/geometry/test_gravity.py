"""What gravity tells of a rotation, and the heading that it leaves open."""

import math

import torch

from tests.tolerances import assert_matches
from torchrefrac.geometry import heading_rotation, level_rotation, rotate, split_heading

DOWN = torch.tensor([0.0, 0.0, -1.0], dtype=torch.float64)


def test_level_rotation_is_a_proper_rotation(draw):
    rotation = level_rotation(_looking_below_zenith(draw, 3, 100))

    identity = torch.eye(3, dtype=torch.float64).expand_as(rotation)
    torch.testing.assert_close(rotation @ rotation.mT, identity, rtol=0.0, atol=1e-12)
    assert_matches(torch.linalg.det(rotation), torch.ones(3, 100, dtype=torch.float64))


def test_level_rotation_maps_world_down_to_gravity_in_the_camera(draw):
    down_in_cam = _looking_below_zenith(draw, 100)

    assert_matches(rotate(level_rotation(down_in_cam), DOWN), down_in_cam)


def test_a_nadir_camera_is_level_after_the_flip_alone():
    nadir = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)

    assert torch.equal(level_rotation(nadir), torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64)))


def test_level_rotation_turns_no_more_than_the_optical_axis_tilts(draw):
    down_in_cam = _looking_below_zenith(draw, 100)
    flip = torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))

    turn = level_rotation(down_in_cam) @ flip

    cosine = (turn.diagonal(dim1=-2, dim2=-1).sum(dim=-1) - 1.0) / 2.0
    assert_matches(cosine, down_in_cam[..., 2])


def test_heading_rotation_turns_counter_clockwise_about_the_vertical():
    turned = heading_rotation(torch.tensor(math.pi / 2, dtype=torch.float64)) @ torch.eye(3, dtype=torch.float64)

    expected = torch.tensor([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
    assert_matches(turned, expected)


def test_split_heading_inverts_the_composition_of_gravity_and_heading(draw):
    down_in_cam, heading = _looking_below_zenith(draw, 2, 100), draw.uniform(-math.pi, math.pi, 2, 100)

    split_down, split = split_heading(level_rotation(down_in_cam) @ heading_rotation(heading))

    assert_matches(split_down, down_in_cam)
    torch.testing.assert_close(split, heading, rtol=0.0, atol=1e-11)


def test_any_rotation_is_its_gravity_times_its_heading(draw):
    rotation = draw.rotations(200)
    rotation = rotation[rotation[:, 2, 2] < 0.99]  # not looking at the zenith

    down_in_cam, heading = split_heading(rotation)

    torch.testing.assert_close(level_rotation(down_in_cam) @ heading_rotation(heading), rotation, rtol=0.0, atol=1e-12)


def test_level_rotation_has_the_right_derivatives(draw):
    down_in_cam = _looking_below_zenith(draw, 4).requires_grad_()

    assert torch.autograd.gradcheck(level_rotation, down_in_cam)


def _looking_below_zenith(draw, *shape):
    """Gravity directions of cameras in any pose but within 8 degrees of the zenith."""
    down = draw.directions(*shape)
    return torch.where(down[..., 2:] < -0.99, -down, down)
