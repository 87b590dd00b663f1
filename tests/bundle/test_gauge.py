"""What no image can tell: 4 freedoms above water, 7 in air."""

from dataclasses import replace

import pytest
import torch
from tolerances import assert_matches

from torchrefrac.bundle.gauge import gauge_directions
from torchrefrac.geometry import heading_rotation
from torchrefrac.optim import Step

in_water_and_air = pytest.mark.parametrize(("index_ratio", "freedoms"), [(1.333, 4), (1.0, 7)], ids=["water", "air"])


@in_water_and_air
def test_the_reduced_hessian_of_a_perfect_state_has_exactly_the_gauge_for_its_null_space(plant, index_ratio, freedoms):
    planted = plant(cameras=5, points=40, index_ratio=index_ratio)
    reduced = _reduced(planted.problem().linearize(planted.truth))

    gauge = gauge_directions(planted.truth.rotation, planted.truth.center, 0, refractive=index_ratio > 1.0)

    values, vectors = torch.linalg.eigh(reduced)
    assert gauge.shape[-1] == freedoms
    assert values[freedoms - 1] < 1e-8 * values[freedoms]
    null = vectors[:, :freedoms]
    torch.testing.assert_close(gauge @ gauge.T, null @ null.T, rtol=0.0, atol=1e-6)


def test_gravity_leaves_the_gauge_through_water_as_it_is(plant):
    planted = plant(cameras=5, points=40)

    reduced = _reduced(planted.problem(gravity=True).linearize(planted.truth))

    gauge = gauge_directions(planted.truth.rotation, planted.truth.center, 0, refractive=True)
    values = torch.linalg.eigvalsh(reduced)
    assert values[3] < 1e-8 * values[4]
    assert (reduced @ gauge).abs().amax() < 1e-9 * reduced.abs().amax()


def test_shared_unknowns_take_no_part_in_the_gauge(plant):
    planted = plant()

    gauge = gauge_directions(planted.truth.rotation, planted.truth.center, 2, refractive=True)

    assert gauge.shape == (6 * 4 + 2, 4)
    assert (gauge[-2:] == 0.0).all()


@in_water_and_air
def test_the_directions_are_orthonormal(plant, index_ratio, freedoms):
    truth = plant(index_ratio=index_ratio).truth

    gauge = gauge_directions(truth.rotation, truth.center, 0, refractive=index_ratio > 1.0)

    assert_matches(gauge.T @ gauge, torch.eye(freedoms, dtype=torch.float64), slack=10.0)


@pytest.mark.parametrize("move", ["x", "y", "heading", "scale"])
def test_moving_cameras_and_points_together_costs_nothing_however_far(plant, disturb, move):
    planted = plant(noise=1.0, land=4)
    problem = planted.problem(gravity=True, loss_scale=0.25)
    state = disturb(planted.truth)

    turn = heading_rotation(torch.tensor(2.0 if move == "heading" else 0.0, dtype=torch.float64))
    shift = torch.tensor((70.0 * (move == "x"), -30.0 * (move == "y"), 0.0), dtype=torch.float64)
    scale = 3.0 if move == "scale" else 1.0
    moved = replace(
        state,
        rotation=state.rotation @ turn.T,
        center=scale * state.center @ turn.T + shift,
        points=scale * state.points @ turn.T + shift,
    )

    assert_matches(problem.cost(moved), problem.cost(state), slack=100.0)


@pytest.mark.parametrize("move", ["z", "tilt"])
def test_through_water_lifting_or_tilting_the_scene_is_seen(plant, move):
    planted = plant()
    tilt = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.995, -0.0998], [0.0, 0.0998, 0.995]], dtype=torch.float64)
    turn = torch.linalg.qr(tilt).Q if move == "tilt" else torch.eye(3, dtype=torch.float64)
    shift = torch.tensor((0.0, 0.0, 1.0 if move == "z" else 0.0), dtype=torch.float64)

    moved = replace(
        planted.truth,
        rotation=planted.truth.rotation @ turn.T,
        center=planted.truth.center @ turn.T + shift,
        points=planted.truth.points @ turn.T + shift,
    )

    assert planted.problem().cost(moved) > 1.0


@in_water_and_air
def test_along_the_gauge_the_cost_grows_with_the_fourth_power_of_the_step(plant, index_ratio, freedoms):
    planted = plant(cameras=3, points=10, index_ratio=index_ratio)
    problem = planted.problem()
    gauge = gauge_directions(planted.truth.rotation, planted.truth.center, 0, refractive=index_ratio > 1.0)
    equations = problem.linearize(planted.truth)

    for direction in gauge.T:
        costs = []
        for size in (1e-2, 2e-2):
            points = _following_points(equations, size * direction)
            moved = problem.retract(planted.truth, Step(size * direction, points, torch.zeros(()), torch.tensor(True)))
            costs.append(float(problem.cost(moved)))
        assert costs[0] < 1e-6
        assert costs[1] < 17.0 * costs[0] + 1e-15


@in_water_and_air
def test_a_step_does_not_drift_along_the_gauge(plant, disturb, index_ratio, freedoms):
    planted = plant(noise=0.5, index_ratio=index_ratio)
    state = disturb(planted.truth, size=0.2)

    equations = planted.problem(free_gauge=True).linearize(state)
    step = equations.solve(1e-6)

    assert step.solved
    assert equations.null_space.shape[-1] == freedoms
    assert (equations.null_space.T @ step.camera).norm() < 1e-3 * step.camera.norm()


def _reduced(equations):
    """The Schur complement B - E^T V^-1 E of the cameras."""
    coupling = _coupling(equations)
    points = torch.linalg.inv(equations.point_hessian)
    return equations.hessian - torch.einsum("pix,pij,pjy->xy", coupling, points, coupling)


def _following_points(equations, cameras):
    """How the points best follow a move of the cameras."""
    rhs = _coupling(equations) @ cameras
    return -torch.linalg.solve(equations.point_hessian, rhs)


def _coupling(equations):
    plan = equations.plan
    coupling = torch.zeros(plan.num_points, 3, plan.num_cameras, 6, dtype=torch.float64)
    coupling[plan.point, :, plan.camera] = equations.coupling
    return coupling.flatten(-2)
