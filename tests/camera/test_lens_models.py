"""OpenCV's rational and fisheye models, and batches of cameras that have different ones."""

import cv2
import numpy as np
import pytest
import torch

from tests.tolerances import assert_matches
from torchrefrac.camera import Intrinsics, RefractiveCamera, distort, distort_with_jacobians, undistort
from torchrefrac.geometry import so3_exp
from torchrefrac.refraction import FlatInterface
from torchrefrac.scene import Cameras

RATIONAL = torch.tensor((0.9, 0.15, 1e-3, -2e-3, 0.01, 1.1, 0.3, 0.02), dtype=torch.float64)
FISHEYE = torch.tensor((0.05, -0.01, 0.003, -0.0005, 0.0), dtype=torch.float64)
YES = torch.tensor(True)
MODELS = [
    Intrinsics.create(640, 480, 500.0, distortion=(-0.05, 0.02, 1e-3, -2e-3, 0.01)),
    Intrinsics.create(640, 480, (400.0, 401.0), (321.5, 239.25), RATIONAL.tolist()),
    Intrinsics.create(480, 640, 300.0, distortion=FISHEYE[:4].tolist(), model="fisheye"),
]
each_model = pytest.mark.parametrize(
    ("coefficients", "fisheye"), [(RATIONAL, None), (FISHEYE, YES)], ids=["rational", "fisheye"]
)


@pytest.fixture
def wide(draw):
    """Image-plane coordinates up to 84 degrees from the axis."""
    angle, turn = draw.uniform(0.0, 1.47, 200), draw.uniform(0.0, 2.0 * np.pi, 200)
    return angle.tan()[:, None] * torch.stack((turn.cos(), turn.sin()), dim=-1)


def test_the_rational_model_is_that_of_opencv(draw):
    xy = draw.uniform(-1.5, 1.5, 100, 2)

    on_plane = np.concatenate((xy.numpy(), np.ones((100, 1))), axis=1)
    expected, _ = cv2.projectPoints(on_plane, np.zeros(3), np.zeros(3), np.eye(3), RATIONAL.numpy())
    assert_matches(distort(xy, RATIONAL), torch.as_tensor(expected[:, 0]))


def test_the_fisheye_model_is_that_of_opencv(wide):
    expected = cv2.fisheye.distortPoints(wide.numpy()[None], np.eye(3), FISHEYE[:4].numpy())

    assert_matches(distort(wide, FISHEYE, YES), torch.as_tensor(expected[0]), slack=10.0)


def test_no_denominator_is_the_model_of_five_coefficients_to_the_last_bit(draw):
    xy = draw.uniform(-0.7, 0.7, 100, 2)
    five = torch.tensor((-0.28, 0.11, 4e-4, -3e-4, -0.02), dtype=torch.float64)
    eight = torch.nn.functional.pad(five, (0, 3))

    assert torch.equal(distort(xy, five), distort(xy, eight))
    assert torch.equal(undistort(xy, five), undistort(xy, eight))
    for one, two in zip(distort_with_jacobians(xy, five)[:2], distort_with_jacobians(xy, eight)[:2], strict=True):
        assert torch.equal(one, two)


def test_no_coefficients_change_nothing(draw):
    xy, none = draw.uniform(-0.7, 0.7, 3, 20, 2), torch.zeros(3, 1, 0, dtype=torch.float64)

    value, by_xy, by_none = distort_with_jacobians(xy, none)

    assert torch.equal(value, xy)
    assert torch.equal(undistort(xy, none), xy)
    assert torch.equal(by_xy, torch.eye(2, dtype=torch.float64).expand(3, 20, 2, 2))
    assert by_none.shape == (3, 20, 2, 0)


def test_undistortion_inverts_the_rational_model_over_a_wide_image(draw):
    xy = draw.uniform(-1.2, 1.2, 500, 2)

    torch.testing.assert_close(undistort(distort(xy, RATIONAL), RATIONAL), xy, rtol=0.0, atol=1e-12)


def test_undistortion_inverts_the_fisheye_model_nearly_to_a_right_angle(wide):
    back = undistort(distort(wide, FISHEYE, YES), FISHEYE, YES)

    torch.testing.assert_close(back, wide, rtol=1e-12, atol=1e-12)


def test_what_no_pinhole_sees_is_undone_to_something_finite():
    beyond = torch.tensor([[1.6, 0.5], [3.0, 4.0], [0.0, 0.0]], dtype=torch.float64)

    assert undistort(beyond, FISHEYE, YES).isfinite().all()


@each_model
def test_closed_form_jacobians_are_those_of_autograd(draw, coefficients, fisheye):
    xy, each = draw.uniform(-1.0, 1.0, 40, 2), coefficients.repeat(40, 1).requires_grad_()
    xy[0] = 0.0
    xy[1:4] *= 1e-4
    xy.requires_grad_()

    value, by_xy, by_coefficients = distort_with_jacobians(xy, each, fisheye)

    assert torch.equal(value, distort(xy, each, fisheye))
    for axis in range(2):
        expected = torch.autograd.grad(value[:, axis].sum(), (xy, each), retain_graph=True)
        torch.testing.assert_close(by_xy[:, axis], expected[0], rtol=1e-9, atol=1e-9)
        torch.testing.assert_close(by_coefficients[:, axis], expected[1], rtol=1e-9, atol=1e-12)


@each_model
def test_undistortion_is_differentiable_in_the_pixel_and_in_the_coefficients(draw, coefficients, fisheye):
    inputs = (draw.uniform(-0.5, 0.5, 3, 2).requires_grad_(), coefficients.clone().requires_grad_())

    assert torch.autograd.gradcheck(lambda xy, k: undistort(xy, k, fisheye), inputs)


def test_the_rational_model_is_finite_where_its_denominator_vanishes():
    lens = torch.tensor((0.1, 0.0, 0.0, 0.0, 0.0, -0.25, 0.0, 0.0), dtype=torch.float64)
    xy = torch.tensor([[2.0, 0.0], [3.0, 1.0], [0.5, 0.5]], dtype=torch.float64)

    assert all(part.isfinite().all() for part in distort_with_jacobians(xy, lens))


@pytest.fixture
def mixed(draw):
    """Three cameras of different models above water, and points in it."""
    rotation = so3_exp(0.2 * draw.normal(3, 3)) @ torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))
    center = torch.cat((draw.uniform(-5.0, 5.0, 3, 2), draw.uniform(30.0, 40.0, 3, 1)), dim=-1)
    points = torch.cat((draw.uniform(-15.0, 15.0, 50, 2), draw.uniform(-30.0, 2.0, 50, 1)), dim=-1)
    lenses = Cameras.of(MODELS).of_views(torch.arange(3))
    return RefractiveCamera(lenses, rotation, center, FlatInterface(1.33)), points


def test_cameras_of_different_models_in_one_batch_see_as_each_does_alone(mixed):
    cameras, points = mixed

    pixels, valid = cameras[:, None].project(points)
    rays = cameras[:, None].cast_rays(pixels)

    for i, lens in enumerate(MODELS):
        alone = RefractiveCamera(lens, *(t[i] for t in (cameras.cam_from_world_rotation, cameras.center_in_world)),
                                 FlatInterface(1.33))  # fmt: skip
        expected, visible = alone.project(points)
        torch.testing.assert_close(pixels[i], expected, rtol=0.0, atol=1e-9)
        assert torch.equal(valid[i], visible)
        for one, two in zip(rays, alone.cast_rays(pixels[i]), strict=True):
            torch.testing.assert_close(one[i], two, rtol=0.0, atol=1e-9)
        assert torch.equal(cameras.intrinsics.indexed(i, (3,)).contains(pixels[i]), lens.contains(pixels[i]))


def test_projections_of_different_models_have_the_derivatives_of_autograd(mixed):
    cameras, points = mixed
    lenses = cameras.intrinsics
    inputs = [t.clone().requires_grad_() for t in (lenses.focal, lenses.distortion, cameras.center_in_world)]

    def pixels(focal, distortion, center):
        each = Intrinsics(640, 640, focal, lenses.principal_point, distortion, lenses.fisheye, lenses.sizes)
        camera = RefractiveCamera(each, cameras.cam_from_world_rotation, center, FlatInterface(1.33))
        return camera.project(points[:3])[0]

    found = torch.autograd.functional.jacobian(pixels, tuple(inputs))
    _, by, _ = cameras.project_with_jacobians(points[:3])

    row = torch.arange(3)
    for name, whole in zip(("focal", "distortion", "center"), found, strict=True):
        torch.testing.assert_close(getattr(by, name), whole[row, :, row], rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize(
    ("model", "distortion", "sentence"),
    [
        ("opencv", (0.1, 0.2), "distortion has 2 numbers, but must have 0 or 4 or 5 or 8 with the model opencv"),
        ("fisheye", RATIONAL.tolist(), "distortion has 8 numbers, but must have 4 with the model fisheye"),
        ("mirror", (), "model is 'mirror', but must be one of opencv, fisheye"),
    ],
)
def test_models_and_numbers_that_do_not_exist_are_refused(model, distortion, sentence):
    with pytest.raises(ValueError, match=sentence):
        Intrinsics.create(640, 480, 500.0, distortion=distortion, model=model)


def test_four_coefficients_are_five_without_the_last():
    assert Intrinsics.create(9, 9, 9.0, distortion=(1.0, 2.0, 3.0, 4.0)).distortion.tolist() == [
        1.0,
        2.0,
        3.0,
        4.0,
        0.0,
    ]
    assert Intrinsics.create(9, 9, 9.0, distortion=()).distortion.tolist() == [0.0] * 5
