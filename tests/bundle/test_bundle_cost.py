"""The adjustment's cost and its derivatives."""

from dataclasses import replace

import pytest
import torch

from tests.bundle.bundle_oracles import (
    cost_by_definition,
    dense_system,
    jacobian_of,
    moved,
    num_unknowns,
    weighted_residuals,
)
from tests.bundle.changes import changed
from tests.tolerances import assert_matches
from torchrefrac.bundle import Expectations, KnownPoints, ScaleBars
from torchrefrac.geometry import so3_exp
from torchrefrac.optim import huber
from torchrefrac.scene import Observations

in_water_and_air = pytest.mark.parametrize("index_ratio", [1.333, 1.0], ids=["water", "air"])
EVERYTHING = ("focal", "principal_point", "radial", "index_ratio", "plane_tilt", "plane_height")


@in_water_and_air
@pytest.mark.parametrize("loss", ["squared", "huber", "cauchy"])
@pytest.mark.parametrize("gravity", [False, True], ids=["free", "gravity"])
@pytest.mark.parametrize("refine", [(), ("radial",)], ids=["intrinsics fixed", "radial"])
def test_the_gradient_is_that_of_autograd_through_the_cost(plant, disturb, index_ratio, loss, gravity, refine):
    planted = plant(noise=0.5, land=4, index_ratio=index_ratio, distortion=(-0.1, 0.03, 0.001, -0.002, 0.0))
    problem = planted.problem(loss=loss, terms=[planted.gravity] if gravity else [], refine=refine)
    state = disturb(planted.truth)

    linearized = problem.linearize(state)

    step = torch.zeros(num_unknowns(problem.layout), dtype=torch.float64, requires_grad=True)
    cost = cost_by_definition(problem, planted.observations, moved(problem.layout, state, step))
    (expected,) = torch.autograd.grad(cost, step)
    actual, size = dense_system(linearized.system)[1], problem.layout.size
    assert_matches(linearized.cost, cost.detach(), slack=100.0)
    for part in (slice(size), slice(size, None)):
        scale = expected[part].abs().amax()
        assert_matches(actual[part] / scale, expected[part] / scale, slack=100.0)


@pytest.mark.parametrize(
    ("refine", "cameras", "interfaces"),
    [((), 1, 1), (EVERYTHING, 1, 1), (EVERYTHING, 2, 2), (("distortion", "plane_height"), 3, 2)],
    ids=["poses and points", "everything", "two cameras and two waters", "three cameras and two levels"],
)
@pytest.mark.parametrize("loss", ["squared", "huber"])
@pytest.mark.parametrize("reduced", [False, True], ids=["points eliminated", "some points reduced"])
def test_the_hessian_is_that_of_gauss_and_newton(plant, disturb, refine, cameras, interfaces, loss, reduced):
    planted = plant(points=10, noise=0.3, cameras=cameras, interfaces=interfaces)
    terms = [planted.gravity, *(_measurements(planted.truth) if reduced else ())]
    fixed = torch.zeros(4, 6, dtype=torch.bool)
    fixed[1, 2:4] = True
    expected_of = Expectations(focal=0.1, index_ratio=0.02, plane_tilt_deg=2.0, plane_height=3.0)
    problem = planted.problem(loss=loss, terms=terms, fixed=fixed, refine=refine, expected=expected_of)
    state = disturb(planted.truth)

    matrix, gradient = dense_system(problem.linearize(state).system)

    residuals = weighted_residuals(problem, planted.observations, state)
    jacobian = jacobian_of(residuals, problem.layout, state)
    expected = jacobian.T @ jacobian
    scale = expected.diagonal().sqrt().clamp(min=1e-300)
    torch.testing.assert_close(matrix / scale / scale[:, None], expected / scale / scale[:, None], rtol=0.0, atol=1e-11)
    slope = jacobian.T @ residuals(state) / scale
    torch.testing.assert_close(gradient / scale, slope, rtol=0.0, atol=1e-11 * float(slope.abs().amax()))


def test_the_order_of_the_observations_changes_nothing(plant, disturb, generator):
    planted = plant(noise=0.5)
    order = torch.randperm(len(planted.observations), generator=generator)
    state = disturb(planted.truth)

    one, two = (
        case.problem(loss="huber", refine=("focal",)).linearize(state)
        for case in (planted, replace(planted, observations=planted.observations[order]))
    )

    assert torch.equal(one.system.rows, two.system.rows)
    assert torch.equal(one.solve(1e-3).eliminated, two.solve(1e-3).eliminated)


def test_a_view_that_sees_a_point_twice_is_refused(plant):
    seen = plant().observations
    twice = Observations(*(torch.cat((value, value[:1])) for value in (seen.view, seen.point, seen.pixels)))

    with pytest.raises(ValueError, match="a view sees a point twice; each pair of view and point may occur once"):
        replace(plant(), observations=twice).problem()


def test_a_perfect_state_costs_nothing(plant):
    planted = plant(land=4, cameras=2, interfaces=2)

    assert planted.problem(terms=[planted.gravity]).linearize(planted.truth).cost < 1e-18


def test_the_cost_is_half_the_sum_of_hubers_loss_over_observations(plant, draw):
    planted = plant()
    error = draw.normal(len(planted.observations), 2)
    noisy = replace(planted, observations=replace(planted.observations, pixels=planted.observations.pixels + error))

    cost = noisy.problem(loss="huber", loss_scale=0.25).linearize(planted.truth).cost

    torch.testing.assert_close(cost, 0.5 * huber(error.square().sum(dim=-1), 0.25)[0].sum())


def test_gravity_that_is_off_by_its_sigma_costs_what_a_pixel_off_by_its_sigma_does(plant):
    planted = plant(views=3)
    axis = torch.linalg.cross(planted.down_in_cam[:1], planted.down_in_cam.new_tensor([[0.0, 0.0, 1.0]]))
    turn = so3_exp(0.01 * torch.nn.functional.normalize(axis, dim=-1))
    down = planted.down_in_cam.clone()
    down[:1] = (turn @ down[:1, :, None])[..., 0]
    tilted = replace(planted, down_in_cam=down)

    cost = tilted.problem(terms=[tilted.gravity]).linearize(planted.truth).cost

    assert float(cost) == pytest.approx(0.5 * 0.3**2, rel=1e-4)


def test_what_is_expected_of_intrinsics_and_water_is_a_prior_on_what_varies_alone(plant):
    planted = plant()
    expected = Expectations(focal=0.01, index_ratio=0.1, plane_height=5.0)
    problem = planted.problem(refine=("focal", "plane_height"), expected=expected)
    focal, offset = planted.truth.cameras.focal * 1.02, planted.truth.interfaces.offset + 5.0
    index_ratio = torch.tensor(1.3, dtype=torch.float64)
    other = changed(planted.truth, focal=focal, offset=offset, index_ratio=index_ratio)

    cost = problem.linearize(other).cost

    pixels = planted.problem().linearize(other).cost
    log = torch.tensor(1.02, dtype=torch.float64).log() / 0.01
    torch.testing.assert_close(cost - pixels, 0.5 * 0.3**2 * (log.square() + 1.0), rtol=1e-6, atol=0.0)


@pytest.mark.parametrize("loss", ["squared", "huber", "cauchy"])
def test_a_point_behind_a_camera_costs_more_than_any_in_the_image_and_stays_finite(plant, loss):
    planted = plant()
    behind = _with_point_behind(planted.truth)
    off = planted.observations.pixels.clone()
    off[planted.observations.point == 0] += 999.0 / 2**0.5
    far = replace(planted, observations=replace(planted.observations, pixels=off))

    cost = planted.problem(loss=loss).linearize(behind).cost

    assert cost.isfinite()
    assert cost > far.problem(loss=loss).linearize(planted.truth).cost


def test_a_point_behind_its_cameras_pulls_at_nothing(plant):
    planted = plant()

    _, gradient = dense_system(planted.problem().linearize(_with_point_behind(planted.truth)).system)

    cameras, points = gradient[:24], gradient[24:].view(-1, 3)
    assert points[0].tolist() == [0.0, 0.0, 0.0]
    assert cameras.isfinite().all()
    assert cameras.abs().amax() < 1e-6


def test_an_index_ratio_below_one_costs_infinitely_much(plant):
    planted = plant()
    below = changed(planted.truth, index_ratio=torch.tensor(0.99, dtype=torch.float64))

    assert planted.problem(refine=("index_ratio",)).linearize(below).cost == torch.inf


def _with_point_behind(state):
    points = state.points.clone()
    points[0] = points.new_tensor((0.0, 0.0, 500.0))
    return changed(state, points=points)


def _measurements(truth):
    """Known coordinates of one point and a bar between two others."""
    information = 4.0 * torch.eye(3, dtype=torch.float64)[None]
    one = torch.ones(1, dtype=torch.float64)
    return (
        KnownPoints(torch.tensor([3]), truth.points[3:4] + 0.1, information),
        ScaleBars(torch.tensor([5]), torch.tensor([7]), 30.0 * one, 0.2 * one),
    )
