"""The Schur complement against the full normal equations."""

from dataclasses import dataclass, fields, replace

import pytest
import torch
from torch import Tensor

from torchrefrac.optim import NormalEquations, SchurPlan, schur

CAMERAS, POINTS = 5, 12


@dataclass(frozen=True)
class Linear:
    """residual (N, 2) and its derivatives in the blocks of a camera, a point and the shared unknowns."""

    camera: Tensor
    point: Tensor
    residual: Tensor
    by_camera: Tensor
    by_point: Tensor
    by_shared: Tensor
    weight: Tensor
    num_points: int = POINTS

    def where(self, keep: Tensor) -> "Linear":
        """Without the residuals that `keep` (N) leaves out."""
        rows = {field.name: getattr(self, field.name)[keep] for field in fields(self) if field.name != "num_points"}
        return replace(self, **rows)

    def plan(self) -> SchurPlan:
        return SchurPlan.create(self.camera, self.point, CAMERAS, self.num_points, self.by_shared.shape[-1])

    def normal_equations(self) -> NormalEquations:
        return self.plan().linearize(self.residual, self.by_camera, self.by_point, self.by_shared, self.weight)

    def dense(self) -> tuple[Tensor, Tensor]:
        """Hessian and gradient of all unknowns: cameras, shared, points."""
        shared = self.by_shared.shape[-1]
        jacobian = torch.zeros(len(self.camera), 2, 6 * CAMERAS + shared + 3 * self.num_points, dtype=torch.float64)
        for row, (camera, point) in enumerate(zip(self.camera.tolist(), self.point.tolist(), strict=True)):
            jacobian[row, :, 6 * camera : 6 * camera + 6] = self.by_camera[row]
            jacobian[row, :, 6 * CAMERAS : 6 * CAMERAS + shared] = self.by_shared[row]
            if self.num_points:
                first = 6 * CAMERAS + shared + 3 * point
                jacobian[row, :, first : first + 3] = self.by_point[row]
        root = self.weight.sqrt()[:, None]
        jacobian, residual = (root[..., None] * jacobian).flatten(0, 1), (root * self.residual).flatten()
        return jacobian.T @ jacobian, jacobian.T @ residual


@pytest.fixture
def make_linear(draw, generator):
    """`make_linear(shared=0)`: 45 of the 60 pairs of 5 cameras and 12 points, with random derivatives."""

    def make(shared=0, num_points=POINTS):
        pairs = torch.randperm(CAMERAS * POINTS, generator=generator)[:45].sort().values
        return Linear(
            camera=pairs % CAMERAS,
            point=pairs // CAMERAS,
            residual=draw.normal(45, 2),
            by_camera=draw.normal(45, 2, 6),
            by_point=draw.normal(45, 2, 3),
            by_shared=draw.normal(45, 2, shared),
            weight=draw.uniform(0.1, 1.0, 45),
            num_points=num_points,
        )

    return make


@pytest.mark.parametrize("shared", [0, 2])
@pytest.mark.parametrize("damping", [0.0, 1e-8, 1e-4, 1.0, 1e4])
def test_the_step_is_that_of_the_full_damped_normal_equations(make_linear, shared, damping):
    linear = make_linear(shared)

    step = linear.normal_equations().solve(damping)

    assert step.solved
    torch.testing.assert_close(_flat(step), _dense_step(linear, damping), rtol=1e-7, atol=1e-9)


@pytest.mark.parametrize("damping", [0.0, 1e-2])
def test_constant_points_leave_the_normal_equations_of_the_cameras(make_linear, damping):
    linear = make_linear(shared=2, num_points=0)

    step = linear.normal_equations().solve(damping)

    assert step.point.shape == (0, 3)
    torch.testing.assert_close(step.camera, _dense_step(linear, damping), rtol=1e-7, atol=1e-9)


@pytest.mark.parametrize("elements", [1, 3 * 32 * 5])
def test_cutting_the_points_into_tiles_changes_nothing(make_linear, monkeypatch, elements):
    linear = make_linear(shared=2)
    whole = linear.normal_equations().solve(1e-3)
    assert len(linear.plan().tiles) == 1

    monkeypatch.setattr(schur, "TILE_ELEMENTS", elements)
    tiled = linear.normal_equations().solve(1e-3)

    assert len(linear.plan().tiles) > 1
    torch.testing.assert_close(_flat(tiled), _flat(whole), rtol=1e-9, atol=1e-11)


@pytest.mark.parametrize("damping", [0.0, 1e-2, 10.0])
@pytest.mark.parametrize("num_points", [POINTS, 0])
def test_the_predicted_decrease_is_that_of_the_quadratic_model(make_linear, damping, num_points):
    linear = make_linear(shared=2, num_points=num_points)
    hessian, gradient = linear.dense()

    step = linear.normal_equations().solve(damping)

    x = _flat(step)
    torch.testing.assert_close(
        step.predicted_decrease, -(gradient @ x) - 0.5 * (x @ hessian @ x), rtol=1e-8, atol=1e-10
    )


def test_more_damping_makes_a_shorter_step(make_linear):
    equations = make_linear().normal_equations()

    lengths = [_flat(equations.solve(damping)).norm() for damping in (0.0, 1e-2, 1.0, 1e2)]

    assert lengths == sorted(lengths, reverse=True)


def test_a_point_that_no_camera_sees_stays_where_it_is(make_linear):
    linear = make_linear()

    step = linear.where(linear.point != 4).normal_equations().solve(1e-4)

    assert step.solved
    assert step.point[4].tolist() == [0.0, 0.0, 0.0]
    assert step.point.isfinite().all()


def test_a_camera_that_sees_nothing_makes_the_system_unsolved_and_the_cameras_stay(make_linear):
    linear = make_linear()

    step = linear.where(linear.camera != 4).normal_equations().solve(1e-4)

    assert not step.solved
    assert (step.camera == 0.0).all()


def test_along_the_null_space_the_undamped_step_stands_still(make_linear, draw):
    equations, hessian, gradient = _with_gauge(make_linear(shared=2), draw)
    assert torch.linalg.eigvalsh(hessian)[3] < 1e-10

    step = equations.solve(0.0)

    assert step.solved
    assert (equations.null_space.T @ step.camera).abs().amax() < 1e-9
    torch.testing.assert_close(hessian @ _flat(step), -gradient, rtol=0.0, atol=1e-8)


def test_along_the_null_space_a_slightly_damped_step_hardly_moves(make_linear, draw):
    equations, _, _ = _with_gauge(make_linear(shared=2), draw)

    step = equations.solve(1e-4)

    assert (equations.null_space.T @ step.camera).norm() < 1e-2 * step.camera.norm()


def test_unsorted_points_are_refused(make_linear):
    linear = make_linear()

    with pytest.raises(ValueError, match="point must be sorted in ascending order"):
        SchurPlan.create(linear.camera.flip(0), linear.point.flip(0), CAMERAS, POINTS)


def _with_gauge(linear, draw):
    """The same problem made blind to four random directions: its equations, and the dense Hessian and gradient."""
    shared = linear.by_shared.shape[-1]
    cameras, common, points = draw.normal(CAMERAS, 6, 4), draw.normal(shared, 4), draw.normal(POINTS, 3, 4)
    local = torch.cat(
        (cameras[linear.camera], common.expand(len(linear.camera), shared, 4), points[linear.point]), dim=1
    )
    basis = torch.linalg.qr(local).Q
    rows = torch.cat((linear.by_camera, linear.by_shared, linear.by_point), dim=-1)
    rows = rows - (rows @ basis) @ basis.mT
    blind = replace(
        linear, by_camera=rows[..., :6], by_shared=rows[..., 6 : 6 + shared], by_point=rows[..., 6 + shared :]
    )
    gauge = torch.linalg.qr(torch.cat((cameras.flatten(0, 1), common))).Q
    return replace(blind.normal_equations(), null_space=gauge), *blind.dense()


def _dense_step(linear, damping):
    hessian, gradient = linear.dense()
    return torch.linalg.solve(hessian + damping * torch.diag(hessian.diagonal()), -gradient)


def _flat(step):
    return torch.cat((step.camera, step.point.flatten()))
