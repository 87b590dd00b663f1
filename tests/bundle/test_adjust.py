"""Bundle adjustment of planted scenes."""

import importlib.util
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from torchrefrac.bundle import BundleOptions, BundleState, GravityPrior, adjust
from torchrefrac.camera import Intrinsics, RefractiveCamera
from torchrefrac.geometry import align_above_plane, align_similarity
from torchrefrac.optim import LevenbergMarquardtOptions, Step, minimize
from torchrefrac.refraction import FlatInterface

SOLVER = LevenbergMarquardtOptions(max_iterations=100, function_tolerance=1e-12)
SQUARED = BundleOptions(loss_scale=1e9, solver=SOLVER)
in_water_and_air = pytest.mark.parametrize("index_ratio", [1.333, 1.0], ids=["water", "air"])


@in_water_and_air
@pytest.mark.parametrize("land", [0, 10], ids=["no land", "land"])
def test_without_noise_the_scene_is_recovered(plant, disturb, index_ratio, land):
    planted = plant(points=40, land=land, index_ratio=index_ratio)

    report = adjust(disturb(planted.truth), **planted.observations, options=SQUARED)

    assert report.costs[-1] < 1e-10
    _assert_same_scene(report.state, planted.truth, 1e-5, above_plane=index_ratio > 1.0)


def test_hubers_loss_recovers_the_scene_in_spite_of_a_few_wrong_observations(plant, disturb, draw):
    planted = plant(points=60)
    wrong = torch.arange(len(planted.pixels)) % 20 == 0
    pixels = torch.where(wrong[:, None], planted.pixels + draw.uniform(-30.0, 30.0, len(wrong), 2), planted.pixels)
    start = disturb(planted.truth, size=0.3)

    robust, squared = (
        adjust(start, **{**planted.observations, "pixels": pixels}, options=replace(SQUARED, loss_scale=scale))
        for scale in (0.01, 1e9)
    )

    assert _center_error(robust.state, planted.truth) < 0.1
    assert _center_error(robust.state, planted.truth) < 0.1 * _center_error(squared.state, planted.truth)


def test_the_radial_terms_of_the_lens_are_recovered_where_they_are_free(plant, disturb):
    planted = plant(points=60, distortion=(-0.12, 0.05, 0.001, 0.002, 0.0))
    known = planted.truth.intrinsics.distortion * torch.tensor([0.0, 0.0, 1.0, 1.0, 1.0], dtype=torch.float64)
    start = disturb(planted.truth, size=0.3)
    start = replace(start, intrinsics=replace(start.intrinsics, distortion=known))

    report = adjust(start, **planted.observations, options=replace(SQUARED, refine_radial=True))

    torch.testing.assert_close(
        report.state.intrinsics.distortion, planted.truth.intrinsics.distortion, rtol=0.0, atol=1e-6
    )
    _assert_same_scene(report.state, planted.truth, 1e-3)


def test_a_lens_that_is_fixed_stays_as_it_is_to_the_last_bit(plant, disturb):
    planted = plant(noise=0.5, distortion=(-0.12, 0.05, 0.0, 0.0, 0.0))

    report = adjust(disturb(planted.truth), **planted.observations, options=SQUARED)

    assert report.state.intrinsics is planted.truth.intrinsics


@in_water_and_air
def test_with_noise_the_cost_is_that_which_scipy_reaches(plant, disturb, index_ratio):
    planted = plant(cameras=3, points=12, noise=0.5, index_ratio=index_ratio)
    start = disturb(planted.truth, size=0.3)

    report = adjust(start, **planted.observations, options=SQUARED)

    def residual(x):
        turn, center, points = np.split(x, [9, 18])
        rotation = Rotation.from_rotvec(turn.reshape(3, 3)).as_matrix() @ start.rotation.numpy()
        camera = RefractiveCamera(
            start.intrinsics,
            torch.from_numpy(rotation),
            torch.from_numpy(center.reshape(3, 3)),
            FlatInterface(index_ratio),
        )
        projected, _ = camera[planted.camera].project(torch.from_numpy(points.reshape(-1, 3))[planted.point])
        return (projected - planted.pixels).flatten().numpy()

    x0 = np.concatenate((np.zeros(9), start.center.flatten().numpy(), start.points.flatten().numpy()))
    oracle = least_squares(residual, x0, method="trf", x_scale="jac", ftol=1e-14, xtol=1e-14, gtol=1e-14)
    assert report.costs[-1] == pytest.approx(oracle.cost, rel=1e-7)


def test_the_scene_of_another_program_reaches_the_cost_that_scipy_reaches_with_its_model(shared_data):
    path = shared_data("../peers/ceres_ba") / "make_scene.py"
    spec = importlib.util.spec_from_file_location("make_scene", path)
    make_scene = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(make_scene)
    scene = make_scene.make(ncam=12, npt=40, per=8)
    camera, point = scene["ci"], scene["pi"]

    start = BundleState(
        torch.from_numpy(Rotation.from_rotvec(scene["aa0"]).as_matrix()),
        torch.from_numpy(scene["C0"]),
        torch.from_numpy(scene["X0"]),
        Intrinsics.create(3000, 3000, scene["f"], (0.0, 0.0)),
    )
    report = adjust(
        start,
        camera=torch.from_numpy(camera),
        point=torch.from_numpy(point),
        pixels=torch.from_numpy(scene["uv"]),
        index_ratio=torch.tensor(scene["delta"], dtype=torch.float64),
        options=SQUARED,
    )

    def residual(x):
        turn, center, points = (part.reshape(-1, 3) for part in np.split(x, [36, 72]))
        projected = make_scene.project(turn[camera], center[camera], points[point], scene["f"], scene["delta"])
        return (projected - scene["uv"]).ravel()

    x0 = np.concatenate([scene[name].ravel() for name in ("aa0", "C0", "X0")])
    oracle = least_squares(residual, x0, x_scale="jac", ftol=1e-10, xtol=1e-12, gtol=1e-12)
    assert report.costs[-1] == pytest.approx(oracle.cost, rel=1e-6)


def test_the_result_is_never_worse_than_the_start_and_the_start_stays_as_it_is(plant):
    planted = plant(noise=0.5)
    rotation, center, points = (
        value.clone() for value in (planted.truth.rotation, planted.truth.center, planted.truth.points)
    )

    report = adjust(planted.truth, **planted.observations, options=SQUARED)

    assert report.costs == sorted(report.costs, reverse=True)
    assert torch.equal(planted.truth.rotation, rotation)
    assert torch.equal(planted.truth.center, center)
    assert torch.equal(planted.truth.points, points)


def test_rotations_stay_rotations(plant, disturb):
    planted = plant(noise=0.5)

    rotation = adjust(disturb(planted.truth), **planted.observations, options=SQUARED).state.rotation

    identity = torch.eye(3, dtype=torch.float64).expand_as(rotation)
    torch.testing.assert_close(rotation @ rotation.mT, identity, rtol=0.0, atol=1e-12)


def test_a_precise_gravity_prior_holds_the_cameras_upright(plant, disturb):
    planted = plant(noise=2.0)
    start = disturb(planted.truth)

    free, held = (
        adjust(start, **planted.observations, options=SQUARED, gravity=gravity)
        for gravity in (None, GravityPrior(planted.down_in_cam, 1e-8))
    )

    assert _tilt(free.state, planted) > 1e-4
    assert _tilt(held.state, planted) < 1e-6


def test_a_vague_gravity_prior_changes_nothing(plant, disturb, draw):
    planted = plant(noise=0.5)
    start = disturb(planted.truth, size=0.3)
    wrong = torch.nn.functional.normalize(planted.down_in_cam + 0.1 * draw.normal(4, 3), dim=-1)

    free = adjust(start, **planted.observations, options=SQUARED)
    vague = adjust(start, **planted.observations, options=SQUARED, gravity=GravityPrior(wrong, 1e4))

    assert vague.costs[-1] == pytest.approx(free.costs[-1], rel=1e-6)


@in_water_and_air
def test_steps_need_no_damping_to_hold_the_scene_in_place(plant, disturb, index_ratio):
    planted = plant(noise=0.5, index_ratio=index_ratio)
    start = disturb(planted.truth, size=0.1)
    undamped = LevenbergMarquardtOptions(max_iterations=6, initial_damping=1e-30)

    report = adjust(start, **planted.observations, options=replace(SQUARED, solver=undamped))

    assert report.status == "converged"
    assert len(report.costs) == report.iterations + 1


def test_the_callback_hears_of_the_costs(plant, disturb):
    planted, heard = plant(noise=0.5), []

    report = adjust(
        disturb(planted.truth), **planted.observations, options=SQUARED, callback=lambda _, cost: heard.append(cost)
    )

    assert heard == report.costs[1:]


def test_a_point_that_one_camera_alone_sees_does_no_harm(plant, disturb):
    planted = plant(points=40)
    keep = (planted.point > 0) | (torch.arange(len(planted.point)) == 0)
    alone = replace(planted, camera=planted.camera[keep], point=planted.point[keep], pixels=planted.pixels[keep])

    report = adjust(disturb(planted.truth), **alone.observations, options=SQUARED)

    assert report.costs[-1] < 1e-10
    rest = torch.arange(40) > 0
    found, truth = (replace(state, points=state.points[rest]) for state in (report.state, planted.truth))
    _assert_same_scene(found, truth, 1e-4)


def test_a_start_with_a_point_behind_its_cameras_is_adjusted_all_the_same(plant, disturb):
    planted = plant(points=40)
    start = disturb(planted.truth, size=0.3)
    start.points[0] = start.points.new_tensor((0.0, 0.0, 500.0))

    report = adjust(start, **planted.observations, options=SQUARED)

    assert report.costs[-1] < report.costs[0]
    assert report.state.points.isfinite().all()
    keep = torch.arange(40) > 0
    alone = replace(report.state, points=report.state.points[keep])
    _assert_same_scene(alone, replace(planted.truth, points=planted.truth.points[keep]), 1e-4)


def test_a_step_that_takes_a_point_behind_its_cameras_is_not_accepted(plant, disturb):
    planted = plant()
    start = disturb(planted.truth)

    report = minimize(_Overshooting(planted.problem()), start, SOLVER)

    assert report.state is start


def test_points_in_disorder_are_refused(plant):
    planted = plant()
    rows = {name: value.flip(0) for name, value in planted.observations.items() if name != "index_ratio"}

    with pytest.raises(ValueError, match="point must be sorted"):
        adjust(planted.truth, **rows, index_ratio=planted.index_ratio, options=SQUARED)


class _Overshooting:
    """A problem whose linear model always promises much of lifting the first point behind its cameras."""

    def __init__(self, problem):
        self.cost, self.retract = problem.cost, problem.retract

    def linearize(self, state):
        point = torch.zeros_like(state.points)
        point[0, 2] = 500.0
        step = Step(state.center.new_zeros(6 * len(state.center)), point, torch.tensor(1e9), torch.tensor(True))
        return SimpleNamespace(solve=lambda damping: step)


def _assert_same_scene(state, truth, tolerance, above_plane=True):
    """Cameras and points agree to `tolerance` centimetres after the alignment that the images leave open."""
    align = align_above_plane if above_plane else align_similarity
    source, target = torch.cat((state.center, state.points)), torch.cat((truth.center, truth.points))
    change = align(source, target)
    torch.testing.assert_close(change.apply(source), target, rtol=0.0, atol=tolerance)
    torch.testing.assert_close(change.apply_to_rotation(state.rotation), truth.rotation, rtol=0.0, atol=tolerance)


def _center_error(state, truth):
    return (align_above_plane(state.center, truth.center).apply(state.center) - truth.center).norm(dim=-1).amax()


def _tilt(state, planted):
    """The largest angle between gravity as the cameras stand and as it was measured."""
    return (-state.rotation[..., 2] - planted.down_in_cam).norm(dim=-1).amax()
