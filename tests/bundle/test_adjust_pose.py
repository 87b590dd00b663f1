"""One view adjusted to known points."""

import numpy as np
import pytest
import torch
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from tests.bundle.changes import changed
from torchrefrac.bundle import GravityPrior, adjust_pose
from torchrefrac.camera import RefractiveCamera
from torchrefrac.refraction import FlatInterface

in_water_and_air = pytest.mark.parametrize("index_ratio", [1.333, 1.0], ids=["water", "air"])


@in_water_and_air
@pytest.mark.parametrize("land", [0, 10, 20], ids=["no land", "both", "land alone"])
def test_without_noise_the_pose_is_recovered(plant, disturb, squared, index_ratio, land):
    planted = plant(views=1, points=20, land=land, index_ratio=index_ratio)
    start = changed(disturb(planted.truth, size=5.0), points=planted.truth.points)

    report = adjust_pose(planted.seen_in(start), squared)

    torch.testing.assert_close(report.scene.views.center, planted.truth.views.center, rtol=0.0, atol=1e-6)
    torch.testing.assert_close(report.scene.views.rotation, planted.truth.views.rotation, rtol=0.0, atol=1e-8)


def test_with_noise_the_pose_is_that_of_scipy(plant, disturb, squared):
    planted = plant(views=1, points=20, noise=1.0)
    start = changed(disturb(planted.truth), points=planted.truth.points)

    report = adjust_pose(planted.seen_in(start), squared)

    def residual(x):
        rotation = Rotation.from_rotvec(x[:3]).as_matrix() @ start.views.rotation[0].numpy()
        camera = RefractiveCamera(
            start.intrinsics, torch.from_numpy(rotation), torch.from_numpy(x[3:]), FlatInterface(1.33)
        )
        return (camera.project(start.points)[0] - planted.observations.pixels).flatten().numpy()

    oracle = least_squares(residual, np.append(np.zeros(3), start.views.center[0].numpy()), x_scale="jac", xtol=1e-14)
    assert report.costs[-1] == pytest.approx(oracle.cost, rel=1e-9)
    torch.testing.assert_close(report.scene.views.center[0], torch.from_numpy(oracle.x[3:]), rtol=0.0, atol=1e-4)


def test_points_camera_and_water_stay_as_they_are_to_the_last_bit(plant, disturb, squared):
    planted = plant(views=1, noise=1.0)
    start = disturb(planted.truth)

    state = adjust_pose(planted.seen_in(start), squared).scene

    assert state.cameras is start.cameras
    assert state.interfaces is start.interfaces
    assert state.points is start.points


def test_a_precise_gravity_prior_keeps_the_view_upright(plant, disturb, squared):
    planted = plant(views=1, noise=2.0)
    start = changed(disturb(planted.truth), points=planted.truth.points)

    prior = GravityPrior(planted.down_in_cam, 1e-8)
    state = adjust_pose(planted.seen_in(start), squared, [prior]).scene

    torch.testing.assert_close(-state.views.rotation[..., 2], planted.down_in_cam, rtol=0.0, atol=1e-6)


def test_a_point_behind_the_camera_does_not_disturb_the_others(plant, disturb, squared):
    planted = plant(views=1, points=20)
    points = planted.truth.points.clone()
    points[0] = points.new_tensor((0.0, 0.0, 500.0))
    start = changed(disturb(planted.truth), points=points)

    report = adjust_pose(planted.seen_in(start), squared)

    torch.testing.assert_close(report.scene.views.center, planted.truth.views.center, rtol=0.0, atol=1e-6)
