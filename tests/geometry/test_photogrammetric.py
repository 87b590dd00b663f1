"""Omega, phi and kappa against single turns multiplied out."""

import math

import numpy as np
import pytest
import torch

from tests.tolerances import assert_matches
from torchrefrac.geometry.photogrammetric import angles_of_rotation, rotation_of_angles

CAM_FROM_IMAGE = np.diag((1.0, -1.0, -1.0))  # from x right, y up, z backward to x right, y down, z forward


def turn(axis, angle):
    c, s = math.cos(angle), math.sin(angle)
    matrix = np.eye(3)
    (i, j) = [(1, 2), (2, 0), (0, 1)][axis]
    matrix[i, i], matrix[i, j], matrix[j, i], matrix[j, j] = c, -s, s, c
    return matrix


def slow(omega, phi, kappa):
    """world_from_image = Rx Ry Rz, one turn after the other."""
    world_from_image = turn(0, omega) @ turn(1, phi) @ turn(2, kappa)
    return CAM_FROM_IMAGE @ world_from_image.T


def test_a_rotation_is_that_of_three_turns(draw):
    angles = draw.uniform(-math.pi, math.pi, 50, 3)

    expected = torch.from_numpy(np.array([slow(*row) for row in angles.tolist()]))

    assert_matches(rotation_of_angles(angles), expected)


def test_angles_of_a_rotation_make_it_again(draw):
    ends = [slow(0.3, side * math.pi / 2, kappa) for side in (-1, 1) for kappa in (0.0, 1.0, -3.0)]
    rotations = torch.cat((draw.rotations(200), torch.from_numpy(np.array(ends))))

    angles = angles_of_rotation(rotations)

    assert bool((angles[:, 1].abs() <= math.pi / 2).all())
    assert_matches(rotation_of_angles(angles), rotations, slack=10.0)


def test_all_zero_is_a_camera_that_looks_down_with_north_up():
    right, down, forward = rotation_of_angles(torch.zeros(3, dtype=torch.float64)).tolist()

    assert (right, down, forward) == ([1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0])


@pytest.mark.parametrize(
    ("angles", "tops"), [((0.0, 0.0, 90.0), (-1.0, 0.0, 0.0)), ((90.0, 0.0, 0.0), (0.0, 0.0, 1.0))]
)
def test_kappa_turns_the_image_to_the_left_and_omega_lifts_its_view_to_the_north(angles, tops):
    found = rotation_of_angles(torch.tensor(angles, dtype=torch.float64).deg2rad())

    torch.testing.assert_close(-found[1], found.new_tensor(tops), rtol=0.0, atol=1e-12)
