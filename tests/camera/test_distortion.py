"""Lens distortion and its inverse."""

import cv2
import numpy as np
import pytest
import torch
from tolerances import DTYPES, assert_matches

from torchrefrac.camera import distort, distort_with_jacobians, undistort

LENSES = {
    "none": (0.0, 0.0, 0.0, 0.0, 0.0),
    "barrel": (-0.25, 0.08, 0.0, 0.0, -0.01),
    "pincushion": (0.3, 0.1, 0.0, 0.0, 0.05),
    "decentred": (-0.1, 0.02, 0.01, -0.02, 0.0),
}
for_every_lens = pytest.mark.parametrize(
    "coefficients", [torch.tensor(c, dtype=torch.float64) for c in LENSES.values()], ids=LENSES.keys()
)


@for_every_lens
def test_distortion_is_that_of_opencv(draw, coefficients):
    xy = draw.uniform(-0.7, 0.7, 100, 2)

    on_plane = np.concatenate((xy.numpy(), np.ones((100, 1))), axis=1)
    expected, _ = cv2.projectPoints(on_plane, np.zeros(3), np.zeros(3), np.eye(3), coefficients.numpy())
    assert_matches(distort(xy, coefficients), torch.as_tensor(expected[:, 0]))


@for_every_lens
def test_undistortion_inverts_distortion(draw, coefficients):
    xy = draw.uniform(-0.7, 0.7, 2, 100, 2)

    torch.testing.assert_close(undistort(distort(xy, coefficients), coefficients), xy, rtol=0.0, atol=1e-12)


def test_undistortion_inverts_distortion_in_single_precision(draw):
    coefficients = torch.tensor(LENSES["barrel"], dtype=torch.float32)
    xy = draw.uniform(-0.7, 0.7, 100, 2).float()

    assert_matches(undistort(distort(xy, coefficients), coefficients), xy)


def test_without_distortion_coordinates_stay_as_they_are_to_the_last_bit(draw):
    xy, none = draw.uniform(-0.7, 0.7, 100, 2), torch.zeros(5, dtype=torch.float64)

    assert torch.equal(distort(xy, none), xy)
    assert torch.equal(undistort(xy, none), xy)


@for_every_lens
def test_closed_form_jacobians_are_those_of_autograd(draw, coefficients):
    xy, each = draw.uniform(-0.7, 0.7, 20, 2).requires_grad_(), coefficients.repeat(20, 1).requires_grad_()

    value, by_xy, by_coefficients = distort_with_jacobians(xy, each)

    assert torch.equal(value, distort(xy, each))
    for axis in range(2):
        expected = torch.autograd.grad(value[:, axis].sum(), (xy, each), retain_graph=True)
        assert_matches(by_xy[:, axis], expected[0])
        assert_matches(by_coefficients[:, axis], expected[1])


@for_every_lens
def test_undistortion_is_differentiable_in_the_pixel_and_in_the_coefficients(draw, coefficients):
    inputs = (draw.uniform(-0.5, 0.5, 3, 2).requires_grad_(), coefficients.clone().requires_grad_())

    assert torch.autograd.gradcheck(undistort, inputs)


@pytest.mark.parametrize("dtype", DTYPES)
def test_every_camera_may_have_its_own_lens(draw, dtype):
    lenses = torch.tensor(list(LENSES.values()), dtype=dtype)
    xy = draw.uniform(-0.7, 0.7, 4, 10, 2).to(dtype)

    distorted = distort(xy, lenses[:, None])

    assert torch.equal(distorted[2], distort(xy[2], lenses[2]))
    assert_matches(undistort(distorted, lenses[:, None]), xy)


def test_no_points_at_all_are_undistorted_to_none():
    assert undistort(torch.empty(0, 2), torch.zeros(5)).shape == (0, 2)
