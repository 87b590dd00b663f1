"""Many small adjustments at once, and their derivatives."""

from dataclasses import replace

import pytest
import torch
from torch.autograd import gradcheck

from tests.tolerances import assert_matches
from torchrefrac.bundle import BundleBatch, BundleOptions, GravityPrior, adjust, adjust_differentiably, adjust_each
from torchrefrac.camera import Intrinsics, RefractiveCamera
from torchrefrac.geometry import Plane, Rigid, so3_exp
from torchrefrac.optim import LevenbergMarquardtOptions
from torchrefrac.refraction import FlatInterface
from torchrefrac.scene import Interfaces, Observations, Scene

TIGHT = LevenbergMarquardtOptions(max_iterations=100, function_tolerance=1e-14)
GAUGE = torch.zeros(3, 6, dtype=torch.bool)
GAUGE[0] = True
GAUGE[1, 3] = True
"""The first view, and one coordinate of the second: no scale is left."""
PX, DOWN = 0.4, 0.01


@pytest.fixture
def plant(draw):
    """`plant(problems, views, points)`: problems near their solutions; every view sees all but one of the points."""

    def make(problems=3, views=3, points=8, focal=600.0, index=1.333, height=0.0, gravity=True):
        looking = so3_exp(0.2 * draw.normal(problems, views, 3)) @ torch.diag(torch.tensor([1.0, -1.0, -1.0]).double())
        center = torch.cat((0.5 * draw.normal(problems, views, 2), draw.uniform(1.0, 1.4, problems, views, 1)), dim=-1)
        seen = torch.cat(
            (0.4 * draw.normal(problems, points, 2), draw.uniform(-0.8, -0.3, problems, points, 1)), dim=-1
        )
        interface = FlatInterface(torch.tensor(index).double(), plane=Plane((0.0, 0.0, 1.0), height))
        lens = Intrinsics.create(1000, 1000, focal)
        pixels, valid = RefractiveCamera(lens, looking, center, interface)[..., None].project(seen[:, None])
        assert valid.all()
        rough = so3_exp(0.01 * draw.normal(problems, views, 3)) @ looking
        weights = draw.uniform(0.5, 1.5, problems, views, points)
        weights[:, -1, 2] = 0.0
        down = torch.nn.functional.normalize(-looking[..., 2] + DOWN * draw.normal(problems, views, 3), dim=-1)
        return BundleBatch(
            RefractiveCamera(lens, rough, center + 0.01 * draw.normal(problems, views, 3), interface),
            seen + 0.01 * draw.normal(problems, points, 3),
            pixels + PX * draw.normal(problems, views, points, 2),
            weights,
            down if gravity else None,
            DOWN,
        )

    return make


def _scene_of(problems, number, pixels=None, weights=None):
    """One of the problems by itself, and its terms."""
    cameras, given = problems.cameras, problems.weights[number] if weights is None else weights[number]
    point, view = torch.ones_like(given.mT, dtype=torch.bool).nonzero(as_tuple=True)
    measured = problems.pixels if pixels is None else pixels
    observations = Observations(view, point, measured[number][view, point], given[view, point])
    interface = cameras.interface
    water = Interfaces.level(float(interface.index_ratio), float(interface.plane.offset))
    pose = Rigid(cameras.cam_from_world_rotation[number], cameras.center_in_world[number])
    scene = Scene.create(pose, cameras.intrinsics, water, problems.points[number], observations)
    down = problems.down_in_cam
    return scene, [] if down is None else [GravityPrior(down[number], problems.down_sigma)]


@pytest.mark.parametrize("loss", ["squared", "huber", "cauchy"])
def test_each_problem_is_adjusted_as_if_it_were_alone(plant, loss):
    problems = plant(height=-0.02)

    found = adjust_each(problems, loss=loss, loss_scale=0.5, pixel_sigma=0.7, fixed=GAUGE, tolerance=1e-15)

    options = BundleOptions(loss=loss, loss_scale=0.5, pixel_sigma=0.7, solver=TIGHT)
    for number in range(3):
        scene, terms = _scene_of(problems, number)
        alone = adjust(scene, options, terms=terms, fixed=GAUGE)
        torch.testing.assert_close(found.points[number], alone.scene.points, rtol=0.0, atol=2e-6)
        torch.testing.assert_close(found.cameras.center_in_world[number], alone.scene.views.center, rtol=0.0, atol=2e-6)
        assert float(found.cost[number]) == pytest.approx(alone.costs[-1], rel=1e-9)
    assert found.converged.all()


@pytest.mark.parametrize("loss", ["squared", "cauchy"])
def test_derivatives_are_those_of_the_adjustment_of_one(plant, loss):
    problems = plant(problems=2)
    pixels, weights = problems.pixels.clone().requires_grad_(), problems.weights.clone().requires_grad_()
    how = {"loss": loss, "loss_scale": 1.0, "pixel_sigma": 0.7}

    found = adjust_each(replace(problems, pixels=pixels, weights=weights), fixed=GAUGE, tolerance=1e-15, **how)
    ours = torch.autograd.grad(
        (found.points**3).sum() + found.cameras.center_in_world.square().sum(), (pixels, weights)
    )

    options, total = BundleOptions(solver=TIGHT, **how), pixels.new_zeros(())
    for number in range(2):
        scene, terms = _scene_of(problems, number, pixels, weights)
        alone = adjust_differentiably(scene, options, terms=terms, fixed=GAUGE)
        total = total + (alone.points**3).sum() + alone.views.center.square().sum()
    for one, other in zip(ours, torch.autograd.grad(total, (pixels, weights)), strict=True):
        size = other.abs().amax()
        torch.testing.assert_close(one / size, other / size, rtol=0.0, atol=1e-5)


@pytest.mark.parametrize("loss", ["squared", "cauchy"])
def test_derivatives_in_all_that_is_given_are_those_of_finite_differences(plant, loss):
    problems = plant(problems=2, points=5)
    lens = problems.cameras.intrinsics

    def adjusted(pixels, weights, down, focal, index, height):
        interface = FlatInterface(index, plane=Plane((0.0, 0.0, 1.0), height))
        cameras = replace(problems.cameras, intrinsics=replace(lens, focal=focal.expand(2)), interface=interface)
        given = BundleBatch(cameras, problems.points, pixels, weights, down, DOWN)
        found = adjust_each(given, loss=loss, loss_scale=1.0, fixed=GAUGE, tolerance=1e-16)
        assert found.converged.all()
        return found.points, found.cameras.center_in_world, found.cameras.cam_from_world_rotation

    numbers = (torch.tensor(value).double() for value in (600.0, 1.333, 0.0))
    given = problems.pixels, problems.weights, problems.down_in_cam, *numbers
    assert gradcheck(adjusted, [one.clone().requires_grad_() for one in given], eps=1e-5, atol=1e-4, rtol=1e-3)


def test_without_anything_fixed_derivatives_of_what_the_gauge_leaves_alone_are_the_same(plant):
    """Distances between points over their mean, by problems that nothing but their observations determines."""
    problems = plant(problems=2, gravity=False)
    slopes = []

    for fixed in (GAUGE, None):
        pixels = problems.pixels.clone().requires_grad_()
        found = adjust_each(replace(problems, pixels=pixels), loss="squared", fixed=fixed, tolerance=1e-16)
        distance = (found.points[:, 1:] - found.points[:, :1]).norm(dim=-1)
        (slope,) = torch.autograd.grad((distance / distance.mean(dim=1, keepdim=True))[:, 2].sum(), pixels)
        slopes.append(slope)

    scale = slopes[0].abs().amax()
    torch.testing.assert_close(slopes[1] / scale, slopes[0] / scale, rtol=0.0, atol=1e-4)


def test_problems_know_nothing_of_each_other(plant):
    problems = plant()
    center = problems.cameras.center_in_world.clone()
    center[1, 0, 2] = -5.0  # under water
    lost = replace(problems, cameras=replace(problems.cameras, center_in_world=center, check=False))

    whole, beside = (adjust_each(one, fixed=GAUGE) for one in (problems, lost))

    for number in (0, 2):
        assert_matches(beside.points[number], whole.points[number], slack=1e6)
    assert beside.converged[[0, 2]].all()
    assert beside.points.isfinite().all()


def test_a_point_that_no_view_sees_stays_where_it_is(plant):
    problems = plant()
    weights = problems.weights.clone()
    weights[:, :, 4] = 0.0
    weights.requires_grad_()

    found = adjust_each(replace(problems, weights=weights))

    assert torch.equal(found.points[:, 4], problems.points[:, 4])
    (slope,) = torch.autograd.grad(found.points.sum(), weights)
    assert slope.isfinite().all()


def test_match_weights_can_be_learnt_end_to_end(plant):
    """Wrong matches lose their weight when the points are compared with the true ones."""
    right = plant(problems=4, points=12)
    truth = adjust_each(right, fixed=GAUGE).points.detach()
    pixels = right.pixels.clone()
    pixels[:, 1, 3] += 30.0
    scores = torch.zeros(right.weights.shape, dtype=torch.float64, requires_grad=True)
    optimizer = torch.optim.Adam([scores], lr=0.3)

    losses = []
    for _ in range(15):
        weights = right.weights * torch.sigmoid(scores + 2.0)
        found = adjust_each(replace(right, pixels=pixels, weights=weights), loss="squared", fixed=GAUGE)
        loss = (found.points - truth).square().sum(dim=-1).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(float(loss.detach()))

    assert losses[-1] < 0.2 * losses[0]
    assert (scores[:, 1, 3] < scores.detach().flatten(1).median(dim=1).values - 1.0).all()


def test_shapes_that_do_not_fit_are_refused(plant):
    problems = plant()

    with pytest.raises(ValueError, match=r"pixels has shape \(3, 3, 7, 2\), but must have \(3, 3, 8, 2\)"):
        replace(problems, pixels=problems.pixels[:, :, 1:])
    with pytest.raises(ValueError, match=r"cameras have batch shape \(2, 3\), but must have \(3, 3\)"):
        replace(problems, cameras=problems.cameras[:2])


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_a_gpu_adjusts_to_the_same(plant):
    problems = plant()
    tensors = {name: getattr(problems, name).cuda() for name in ("points", "pixels", "weights", "down_in_cam")}

    here, there = (
        adjust_each(problems),
        adjust_each(replace(problems, cameras=problems.cameras.to(device="cuda"), **tensors)),
    )

    torch.testing.assert_close(there.points.cpu(), here.points, rtol=0.0, atol=1e-8)
