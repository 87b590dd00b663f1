"""Bundle adjustment of planted scenes."""

import importlib.util
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from tests.bundle.changes import changed
from torchrefrac.bundle import GravityPrior, adjust
from torchrefrac.camera import Intrinsics, RefractiveCamera
from torchrefrac.geometry import Rigid, align_above_plane, align_similarity
from torchrefrac.optim import LevenbergMarquardtOptions, Step, minimize
from torchrefrac.refraction import FlatInterface
from torchrefrac.scene import Interfaces, Observations, Scene

in_water_and_air = pytest.mark.parametrize("index_ratio", [1.333, 1.0], ids=["water", "air"])


@in_water_and_air
@pytest.mark.parametrize("land", [0, 10], ids=["no land", "land"])
def test_without_noise_the_scene_is_recovered(plant, disturb, index_ratio, land):
    planted = plant(points=30, land=land, index_ratio=index_ratio)

    report = planted.adjusted(disturb(planted.truth))

    assert report.costs[-1] < 1e-10
    _assert_same_scene(report.scene, planted.truth, 1e-5, above_plane=index_ratio > 1.0)


def test_hubers_loss_recovers_the_scene_in_spite_of_a_few_wrong_observations(plant, disturb, draw):
    planted = plant(points=40)
    wrong = planted.with_wrong_observations(draw)
    start = disturb(planted.truth, size=0.1)

    robust, squared = (wrong.adjusted(start, loss=loss, loss_scale=0.01) for loss in ("huber", "squared"))

    assert _center_error(robust.scene, planted.truth) < 0.1
    assert _center_error(robust.scene, planted.truth) < 0.1 * _center_error(squared.scene, planted.truth)


def test_the_radial_terms_of_the_distortion_are_recovered_where_they_are_free(plant, disturb):
    planted = plant(points=60, distortion=(-0.12, 0.05, 0.001, 0.002, 0.0))
    known = planted.truth.cameras.distortion * torch.tensor([0.0] * 2 + [1.0] * 6, dtype=torch.float64)
    start = disturb(planted.truth, size=0.3)
    start = changed(start, distortion=known)

    report = planted.adjusted(start, refine=("radial",))

    torch.testing.assert_close(report.scene.cameras.distortion, planted.truth.cameras.distortion, rtol=0.0, atol=1e-6)
    _assert_same_scene(report.scene, planted.truth, 1e-3)


def test_a_camera_and_a_water_that_are_fixed_stay_as_they_are_to_the_last_bit(plant, disturb):
    planted = plant(noise=0.5, distortion=(-0.12, 0.05, 0.0, 0.0, 0.0))

    report = planted.adjusted(disturb(planted.truth))

    assert report.scene.cameras is planted.truth.cameras
    assert report.scene.interfaces is planted.truth.interfaces


@in_water_and_air
def test_with_noise_the_cost_is_that_which_scipy_reaches(plant, disturb, index_ratio):
    planted = plant(views=3, points=9, noise=0.5, index_ratio=index_ratio)
    start = disturb(planted.truth, size=0.05)

    report = planted.adjusted(start)

    def residual(x):
        turn, center, points = np.split(x, [9, 18])
        rotation = Rotation.from_rotvec(turn.reshape(3, 3)).as_matrix() @ start.views.rotation.numpy()
        camera = RefractiveCamera(
            start.intrinsics,
            torch.from_numpy(rotation),
            torch.from_numpy(center.reshape(3, 3)),
            FlatInterface(index_ratio),
        )
        seen = planted.observations
        projected, _ = camera[seen.view].project(torch.from_numpy(points.reshape(-1, 3))[seen.point])
        return (projected - seen.pixels).flatten().numpy()

    x0 = np.concatenate((np.zeros(9), start.views.center.flatten().numpy(), start.points.flatten().numpy()))
    oracle = least_squares(residual, x0, method="trf", x_scale="jac", ftol=1e-11, xtol=1e-11, gtol=1e-11)
    assert report.costs[-1] == pytest.approx(oracle.cost, rel=1e-7)


def test_the_scene_of_another_program_reaches_the_cost_that_scipy_reaches_with_its_model(shared_data, squared):
    path = shared_data("../peers/ceres_ba") / "make_scene.py"
    spec = importlib.util.spec_from_file_location("make_scene", path)
    make_scene = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(make_scene)
    scene = make_scene.make(ncam=6, npt=16, per=5)
    camera, point = scene["ci"], scene["pi"]

    start = Scene.create(
        Rigid(torch.from_numpy(Rotation.from_rotvec(scene["aa0"]).as_matrix()), torch.from_numpy(scene["C0"])),
        Intrinsics.create(3000, 3000, scene["f"], (0.0, 0.0)),
        Interfaces.level(scene["delta"]),
        torch.from_numpy(scene["X0"]),
        Observations(torch.from_numpy(camera), torch.from_numpy(point), torch.from_numpy(scene["uv"])),
    )
    report = adjust(start, squared)

    def residual(x):
        turn, center, points = (part.reshape(-1, 3) for part in np.split(x, [18, 36]))
        projected = make_scene.project(turn[camera], center[camera], points[point], scene["f"], scene["delta"])
        return (projected - scene["uv"]).ravel()

    x0 = np.concatenate([scene[name].ravel() for name in ("aa0", "C0", "X0")])
    oracle = least_squares(residual, x0, x_scale="jac", ftol=1e-10, xtol=1e-12, gtol=1e-12)
    assert report.costs[-1] == pytest.approx(oracle.cost, rel=1e-6)


def test_the_result_is_never_worse_than_the_start_and_the_start_stays_as_it_is(plant):
    planted = plant(noise=0.5)
    rotation, center, points = (
        value.clone() for value in (planted.truth.views.rotation, planted.truth.views.center, planted.truth.points)
    )

    report = planted.adjusted(planted.truth)

    assert report.costs == sorted(report.costs, reverse=True)
    assert torch.equal(planted.truth.views.rotation, rotation)
    assert torch.equal(planted.truth.views.center, center)
    assert torch.equal(planted.truth.points, points)


def test_rotations_stay_rotations(plant, disturb):
    planted = plant(noise=0.5)

    rotation = planted.adjusted(disturb(planted.truth)).scene.views.rotation

    identity = torch.eye(3, dtype=torch.float64).expand_as(rotation)
    torch.testing.assert_close(rotation @ rotation.mT, identity, rtol=0.0, atol=1e-12)


def test_a_precise_gravity_prior_keeps_the_views_upright(plant, disturb):
    planted = plant(noise=2.0)
    start = disturb(planted.truth)

    free, fixed = (planted.adjusted(start, terms=terms) for terms in ([], [GravityPrior(planted.down_in_cam, 1e-8)]))

    assert _tilt(free.scene, planted) > 1e-4
    assert _tilt(fixed.scene, planted) < 1e-6


def test_a_vague_gravity_prior_changes_nothing(plant, disturb, draw):
    planted = plant(noise=0.5)
    start = disturb(planted.truth, size=0.3)
    wrong = torch.nn.functional.normalize(planted.down_in_cam + 0.1 * draw.normal(4, 3), dim=-1)

    free, vague = (planted.adjusted(start, terms=terms) for terms in ([], [GravityPrior(wrong, 1e4)]))

    assert vague.costs[-1] == pytest.approx(free.costs[-1], rel=1e-6)


@in_water_and_air
def test_steps_need_no_damping_to_hold_the_scene_in_place(plant, disturb, index_ratio):
    planted = plant(noise=0.5, index_ratio=index_ratio)
    start = disturb(planted.truth, size=0.1)
    undamped = LevenbergMarquardtOptions(max_iterations=6, initial_damping=1e-30)

    report = planted.adjusted(start, solver=undamped)

    assert report.status == "converged"
    assert len(report.costs) == report.iterations + 1


def test_the_callback_is_given_the_costs(plant, disturb):
    planted, given = plant(noise=0.5), []

    report = planted.adjusted(disturb(planted.truth), callback=lambda _, cost, damping: given.append(cost))

    assert given == report.costs[1:]


def test_a_point_that_one_camera_alone_sees_does_no_harm(plant, disturb):
    planted = plant(points=40)
    seen = planted.observations
    alone = planted.without((seen.point == 0) & (torch.arange(len(seen)) > 0))

    report = alone.adjusted(disturb(planted.truth), check=False)

    assert report.costs[-1] < 1e-10
    rest = torch.arange(40) > 0
    found, truth = (changed(state, points=state.points[rest]) for state in (report.scene, planted.truth))
    _assert_same_scene(found, truth, 1e-4)


def test_a_start_with_a_point_behind_its_cameras_is_adjusted_all_the_same(plant, disturb):
    planted = plant(points=40)
    start = disturb(planted.truth, size=0.3)
    start.points[0] = start.points.new_tensor((0.0, 0.0, 500.0))

    report = planted.adjusted(start)

    assert report.costs[-1] < report.costs[0]
    assert report.scene.points.isfinite().all()
    keep = torch.arange(40) > 0
    alone = changed(report.scene, points=report.scene.points[keep])
    _assert_same_scene(alone, changed(planted.truth, points=planted.truth.points[keep]), 1e-4)


def test_a_step_that_takes_a_point_behind_its_cameras_is_not_accepted(plant, disturb):
    planted = plant()
    start = disturb(planted.truth)

    report = minimize(_Overshooting(planted.problem()), start, LevenbergMarquardtOptions(max_iterations=20))

    assert report.state is start


def test_observations_may_come_in_any_order(plant, disturb, generator):
    planted = plant(noise=0.5)
    order = torch.randperm(len(planted.observations), generator=generator)
    start = disturb(planted.truth)

    sorted_, shuffled = (
        case.adjusted(start).scene for case in (planted, replace(planted, observations=planted.observations[order]))
    )

    assert torch.equal(sorted_.points, shuffled.points)
    assert torch.equal(sorted_.views.center, shuffled.views.center)


def test_a_start_that_costs_infinitely_much_is_returned_with_a_status(plant):
    planted = plant()
    start = changed(planted.truth, index_ratio=torch.tensor(0.9, dtype=torch.float64))

    report = planted.adjusted(start)

    assert report.status == "not_finite"
    assert report.scene is start


@pytest.mark.parametrize("refine", [(), ("focal", "plane_height")], ids=["poses and points", "intrinsics and water"])
@pytest.mark.parametrize("solver", ["banded", "iterative"])
def test_other_solvers_come_to_the_same_minimum_as_the_dense_one(plant, disturb, refine, solver):
    planted = plant(noise=0.5, cameras=2)
    start = disturb(planted.truth, size=0.2)

    dense, other = (
        planted.adjusted(start, refine=refine, reduced_solver=name, terms=[planted.gravity])
        for name in ("dense", solver)
    )

    assert other.costs[-1] == pytest.approx(dense.costs[-1], rel=1e-8)


class _Overshooting:
    """A problem whose linear model always promises much of lifting the first point behind its cameras."""

    def __init__(self, problem):
        self.problem, self.retract = problem, problem.retract

    def linearize(self, state, near=False):
        point = torch.zeros_like(state.points)
        point[0, 2] = 500.0
        step = Step(
            state.views.center.new_zeros(6 * len(state.views.center)), point, torch.tensor(1e9), torch.tensor(True)
        )
        return SimpleNamespace(cost=self.problem.linearize(state).cost, solve=lambda damping: step)


def _assert_same_scene(state, truth, tolerance, above_plane=True):
    """Cameras and points agree to `tolerance` centimetres after the alignment that the images leave open."""
    align = align_above_plane if above_plane else align_similarity
    source, target = torch.cat((state.views.center, state.points)), torch.cat((truth.views.center, truth.points))
    change = align(source, target)
    torch.testing.assert_close(change.apply(source), target, rtol=0.0, atol=tolerance)
    torch.testing.assert_close(
        change.apply_to_rotation(state.views.rotation), truth.views.rotation, rtol=0.0, atol=tolerance
    )


def _center_error(state, truth):
    return (
        (align_above_plane(state.views.center, truth.views.center).apply(state.views.center) - truth.views.center)
        .norm(dim=-1)
        .amax()
    )


def _tilt(state, planted):
    """The largest angle between gravity as the cameras stand and as it was measured."""
    return (-state.views.rotation[..., 2] - planted.down_in_cam).norm(dim=-1).amax()
