"""Lens distortion and its inverse."""

import cv2
import numpy as np
import pytest
import torch

from tests.tolerances import DTYPES, assert_matches, assert_same_pixels
from torchrefrac.camera import distort, distort_with_jacobians, undistort

LENSES = {
    "none": (0.0, 0.0, 0.0, 0.0, 0.0),
    "barrel": (-0.25, 0.08, 0.0, 0.0, -0.01),
    "pincushion": (0.3, 0.1, 0.0, 0.0, 0.05),
    "decentred": (-0.1, 0.02, 0.01, -0.02, 0.0),
    "action camera": (-0.28, 0.11, 0.0004, -0.0003, -0.02),
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
    xy = draw.uniform(-0.7, 0.7, len(LENSES), 10, 2).to(dtype)

    distorted = distort(xy, lenses[:, None])

    assert torch.equal(distorted[2], distort(xy[2], lenses[2]))
    assert_matches(undistort(distorted, lenses[:, None]), xy)


@for_every_lens
@pytest.mark.parametrize("reach", [0.3, 0.8])
def test_strong_lenses_are_undone_to_a_billionth_of_a_pixel_up_to_the_corners_of_a_wide_image(coefficients, reach):
    along = torch.linspace(-reach, reach, 101, dtype=torch.float64)
    ideal = torch.stack(torch.meshgrid(along, along, indexing="ij"), dim=-1)
    focal = 1500.0

    back = undistort(distort(ideal, coefficients), coefficients)

    assert_same_pixels(focal * back, focal * ideal)
    assert_same_pixels(focal * distort(back, coefficients), focal * distort(ideal, coefficients))


@for_every_lens
def test_the_derivatives_of_undistortion_invert_those_of_distortion(draw, coefficients):
    ideal = draw.uniform(-0.6, 0.6, 50, 2)
    distorted, by_ideal, _ = distort_with_jacobians(ideal, coefficients)

    by_distorted = torch.func.vmap(torch.func.jacrev(undistort), (0, None))(distorted, coefficients)

    assert_matches(by_distorted @ by_ideal, torch.eye(2, dtype=torch.float64).expand(50, 2, 2), slack=100.0)


@pytest.mark.parametrize("shapes", [((4, 1), (7,)), ((1,), (4, 7)), ((4, 7), ()), ((), (4, 7))])
def test_points_and_lenses_of_any_batches_broadcast(draw, shapes):
    xy, coefficients = draw.uniform(-0.5, 0.5, *shapes[0], 2), 0.05 * draw.uniform(-1.0, 1.0, *shapes[1], 5)

    distorted, by_xy, by_coefficients = distort_with_jacobians(xy, coefficients)
    back = undistort(distorted, coefficients)

    batch = torch.broadcast_shapes(*shapes)
    assert back.shape == distorted.shape == (*batch, 2)
    assert by_xy.shape == (*batch, 2, 2)
    assert by_coefficients.shape == (*batch, 2, 5)
    torch.testing.assert_close(back, xy.expand_as(back), rtol=0.0, atol=1e-13)
    assert undistort(xy, coefficients).shape == (*batch, 2)


def test_no_points_at_all_are_undistorted_to_none():
    assert undistort(torch.empty(0, 2), torch.zeros(5)).shape == (0, 2)
