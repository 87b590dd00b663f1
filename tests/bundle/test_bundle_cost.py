"""The adjustment's cost and its derivatives."""

from dataclasses import replace

import pytest
import torch
from tolerances import assert_matches

from torchrefrac.geometry import so3_exp
from torchrefrac.optim import Step, huber

in_water_and_air = pytest.mark.parametrize("index_ratio", [1.333, 1.0], ids=["water", "air"])


@in_water_and_air
@pytest.mark.parametrize("loss_scale", [1e9, 0.25], ids=["squared", "huber"])
@pytest.mark.parametrize("gravity", [False, True], ids=["free", "gravity"])
@pytest.mark.parametrize("refine_radial", [False, True], ids=["lens fixed", "radial"])
def test_the_gradient_is_that_of_autograd_through_the_cost(
    plant, disturb, index_ratio, loss_scale, gravity, refine_radial
):
    planted = plant(noise=0.5, land=4, index_ratio=index_ratio, distortion=(-0.1, 0.03, 0.001, -0.002, 0.0))
    problem = planted.problem(loss_scale=loss_scale, gravity=gravity, refine_radial=refine_radial)
    state = disturb(planted.truth)

    equations = problem.linearize(state)

    expected = _gradients(problem, state)
    for actual, gradient in zip((equations.gradient, equations.point_gradient), expected, strict=True):
        assert_matches(actual / gradient.abs().amax(), gradient / gradient.abs().amax(), slack=100.0)


@in_water_and_air
def test_the_hessian_is_that_of_gauss_and_newton(plant, disturb, index_ratio):
    planted = plant(index_ratio=index_ratio, distortion=(-0.1, 0.03, 0.0, 0.0, 0.0))
    problem = planted.problem(refine_radial=True)
    state = disturb(planted.truth)

    equations = problem.linearize(state)

    def residual(step):
        return problem.residuals(_moved(problem, state, step))[0].flatten()

    jacobian = torch.autograd.functional.jacobian(residual, torch.zeros(6 * 4 + 2 + 3 * 30, dtype=torch.float64))
    expected = jacobian.T @ jacobian
    scale = expected.diagonal().sqrt()
    torch.testing.assert_close(
        _dense(equations) / scale / scale[:, None], expected / scale / scale[:, None], rtol=0.0, atol=1e-11
    )


def test_a_perfect_state_costs_nothing(plant):
    planted = plant(land=4)

    assert planted.problem(gravity=True).cost(planted.truth) < 1e-18


def test_the_cost_is_half_the_sum_of_hubers_loss_over_observations(plant, draw):
    planted = plant()
    error = draw.normal(len(planted.pixels), 2)
    noisy = replace(planted, pixels=planted.pixels + error)

    cost = noisy.problem(loss_scale=0.25).cost(planted.truth)

    torch.testing.assert_close(cost, 0.5 * huber(error.square().sum(dim=-1), 0.25)[0].sum())


def test_gravity_that_is_off_by_its_sigma_costs_what_a_pixel_off_by_its_sigma_does(plant):
    planted = plant(cameras=3)
    axis = torch.linalg.cross(planted.down_in_cam[:1], planted.down_in_cam.new_tensor([[0.0, 0.0, 1.0]]))
    turn = so3_exp(0.01 * torch.nn.functional.normalize(axis, dim=-1))
    down = planted.down_in_cam.clone()
    down[:1] = (turn @ down[:1, :, None])[..., 0]

    cost = replace(planted, down_in_cam=down).problem(gravity=True).cost(planted.truth)

    assert float(cost) == pytest.approx(0.5 * 0.3**2, rel=1e-4)


@pytest.mark.parametrize("loss_scale", [1e9, 0.25], ids=["squared", "huber"])
def test_a_point_behind_a_camera_costs_more_than_any_in_the_image_and_stays_finite(plant, loss_scale):
    planted = plant()
    problem = planted.problem(loss_scale=loss_scale)
    behind = planted.truth.points.clone()
    behind[0] = planted.truth.points.new_tensor((0.0, 0.0, 500.0))
    off = planted.pixels.clone()
    off[planted.point == 0] += 999.0 / 2**0.5

    cost = problem.cost(replace(planted.truth, points=behind))

    assert cost.isfinite()
    assert cost > replace(problem, pixels=off).cost(planted.truth)


def test_a_point_behind_its_cameras_pulls_at_nothing(plant):
    planted = plant()
    behind = planted.truth.points.clone()
    behind[0] = planted.truth.points.new_tensor((0.0, 0.0, 500.0))

    equations = planted.problem().linearize(replace(planted.truth, points=behind))

    assert equations.point_gradient[0].tolist() == [0.0, 0.0, 0.0]
    assert equations.gradient.isfinite().all()
    assert equations.gradient.abs().amax() < 1e-6


def _gradients(problem, state):
    cameras = torch.zeros(problem.plan.reduced_size, dtype=torch.float64, requires_grad=True)
    points = torch.zeros_like(state.points, requires_grad=True)
    step = Step(cameras, points, torch.zeros(()), torch.tensor(True))
    return torch.autograd.grad(problem.cost(problem.retract(state, step)), (cameras, points))


def _moved(problem, state, step):
    size = problem.plan.reduced_size
    return problem.retract(state, Step(step[:size], step[size:].reshape(-1, 3), torch.zeros(()), torch.tensor(True)))


def _dense(equations):
    """The full matrix [[B, E^T], [E, V]] of the equations."""
    plan = equations.plan
    size, count = plan.reduced_size, plan.num_points
    coupling = torch.zeros(count, 3, size, dtype=torch.float64)
    for row, (camera, point) in enumerate(zip(plan.camera.tolist(), plan.point.tolist(), strict=True)):
        coupling[point, :, 6 * camera : 6 * camera + 6] = equations.coupling[row]
    coupling[..., size - plan.num_shared :] = equations.shared_coupling
    coupling = coupling.flatten(0, 1)
    points = torch.block_diag(*equations.point_hessian)
    return torch.cat((torch.cat((equations.hessian, coupling.T), dim=1), torch.cat((coupling, points), dim=1)), dim=0)
