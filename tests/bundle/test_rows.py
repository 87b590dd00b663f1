"""Weighted residuals and their derivatives, row by row."""

import shutil
from dataclasses import replace

import pytest
import torch

from tests.bundle.bundle_oracles import curvature_of, dense_jacobian, errors_of, jacobian_of
from tests.bundle.changes import changed
from tests.tolerances import assert_matches
from torchrefrac.bundle.rows import IMPOSSIBLE_PX, INTRINSICS, OF_LAYERS, WATER, RowModel, observation_rows
from torchrefrac.optim import robust

LOSSES = ("squared", "huber", "cauchy", "truncated")
GLASS = 1.5
OF_SURFACES = tuple(name for name in WATER if name not in OF_LAYERS)
every_loss = pytest.mark.parametrize("loss", LOSSES)


@pytest.fixture
def rows_of():
    """`rows_of(planted, state, refine, ...)`: rows and cost of all observations; options are those of `RowModel`."""

    def make(planted, state, refine=(), compiled=False, **options):
        model = RowModel(
            tuple(name for name in INTRINSICS if name in refine),
            tuple(name for name in WATER if name in refine),
            **options,
        )
        return observation_rows(model, state, planted.observations, compiled)

    return make


@pytest.mark.parametrize("name", [*INTRINSICS, *WATER])
@pytest.mark.parametrize(("cameras", "interfaces"), [(1, 1), (2, 1), (1, 2), (3, 2)])
def test_every_unknown_has_the_derivative_of_autograd_through_the_camera(
    plant, disturb, rows_of, name, cameras, interfaces
):
    glass = GLASS if name in OF_LAYERS else None
    given = {"points": 8, "land": 1, "cameras": cameras, "interfaces": interfaces, "glass": glass}
    planted = plant(**given, distortion=(-0.1, 0.03, 0.001, -0.002, 0.01))

    _assert_rows_of_autograd(planted, disturb(planted.truth), rows_of, (name,))


@pytest.mark.parametrize("interfaces", [1, 2])
def test_rows_of_dry_points_have_the_derivatives_of_autograd_and_none_in_the_water(plant, disturb, rows_of, interfaces):
    planted = plant(points=8, interfaces=interfaces)
    state = replace(disturb(planted.truth), dry=torch.arange(8) % 2 == 0)
    refine = ("focal", *OF_SURFACES)

    _assert_rows_of_autograd(planted, state, rows_of, refine)

    rows, _ = rows_of(planted, state, refine, loss="squared")
    air = replace(
        state, dry=None, interfaces=replace(state.interfaces, index_ratio=torch.ones_like(state.interfaces.index_ratio))
    )
    straight, _ = rows_of(planted, air, refine, loss="squared")
    dry, water = state.dry[planted.observations.point], slice(7, 11)
    without_index = [row for row in range(rows.shape[1]) if row != 7]
    assert_matches(rows[:, without_index][..., dry], straight[:, without_index][..., dry], slack=10.0)
    assert (rows[:, water][..., dry] == 0.0).all()
    assert (rows[:, water][..., ~dry] != 0.0).any()


@pytest.mark.parametrize(
    "intrinsics", [("focal", "principal_point", "radial"), ("focal", "principal_point", "distortion")]
)
@pytest.mark.parametrize("index_ratio", [1.333, 1.0], ids=["water", "air"])
def test_all_unknowns_together_stand_in_their_order(plant, disturb, rows_of, intrinsics, index_ratio):
    planted = plant(points=8, cameras=2, interfaces=2, index_ratio=index_ratio)

    _assert_rows_of_autograd(planted, disturb(planted.truth), rows_of, (*intrinsics, *OF_SURFACES))


def test_the_last_row_is_the_projection_minus_the_pixel(plant, disturb, rows_of):
    planted = plant(noise=0.5, cameras=2, interfaces=2)
    state = disturb(planted.truth)

    rows, _ = rows_of(planted, state, loss="squared")

    assert_matches(rows[:, -1].T, errors_of(state, planted.observations), slack=1e3)


@every_loss
def test_a_robust_loss_weighs_all_rows_of_an_observation(plant, disturb, rows_of, loss):
    planted = plant(noise=1.0)
    state, refine = disturb(planted.truth, size=0.05), ("focal", *OF_SURFACES)
    plain, _ = rows_of(planted, state, refine, loss="squared")

    rows, cost = rows_of(planted, state, refine, loss=loss, loss_scale=1.5)

    weight = robust(errors_of(state, planted.observations).square().sum(dim=-1), loss, 1.5)[1]
    assert loss == "squared" or 0 < int((weight < 0.9).sum()) < len(weight)
    _assert_weighted_by_loss(rows, cost, plain, loss, 1.5)


@every_loss
def test_an_impossible_observation_weighs_nothing_and_costs_as_one_that_is_far_off(plant, rows_of, loss):
    planted = plant()
    points = planted.truth.points.clone()
    points[3] = points.new_tensor((0.0, 0.0, 500.0))
    state = changed(planted.truth, points=points)

    rows, cost = rows_of(planted, state, ("radial", *OF_SURFACES), loss=loss)

    behind = planted.observations.point == 3
    far = torch.full((int(behind.sum()),), IMPOSSIBLE_PX**2, dtype=torch.float64)
    assert (rows[..., behind] == 0.0).all()
    assert rows.isfinite().all()
    assert (rows[:, :, ~behind].abs().amax(dim=1) > 0.0).all()
    assert_matches(cost, 0.5 * robust(far, loss, 0.25)[0].sum())


def test_a_camera_below_its_water_sees_nothing(plant, rows_of):
    planted = plant(interfaces=2)
    offset = planted.truth.interfaces.offset.clone()
    offset[1] = 100.0

    rows, cost = rows_of(planted, changed(planted.truth, offset=offset), loss="squared")

    below = planted.truth.views.interface[planted.observations.view] == 1
    assert (rows[..., below] == 0.0).all()
    assert float(cost) == pytest.approx(0.5 * IMPOSSIBLE_PX**2 * int(below.sum()))


def test_parts_that_all_cameras_share_need_no_copies(plant, disturb, rows_of):
    planted = plant(cameras=3)
    cameras, state = planted.truth.cameras, disturb(planted.truth)
    shared = {
        "distortion": cameras.distortion[1].expand(3, 8),
        "principal_point": cameras.principal_point[1].expand(3, 2),
    }
    copied = {name: value.clone() for name, value in shared.items()}

    one, two = (rows_of(planted, changed(state, **kind), ("focal", "distortion"))[0] for kind in (shared, copied))

    assert torch.equal(one, two)


def test_more_observations_than_fit_a_block_are_worked_through_block_by_block(plant, disturb, rows_of, monkeypatch):
    planted = plant(noise=0.5, cameras=2, interfaces=2)
    state = disturb(planted.truth)
    whole, cost = rows_of(planted, state, ("focal", *OF_SURFACES))
    monkeypatch.setattr("torchrefrac.bundle.rows.BLOCK", 7)

    blocks, sum_of_costs = rows_of(planted, state, ("focal", *OF_SURFACES))

    assert_matches(blocks, whole, slack=1e3)
    assert_matches(sum_of_costs, cost, slack=10.0)


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("c++") is None, reason="torch.compile needs a C++ compiler")
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("dry", [False, True], ids=["in water", "some dry"])
def test_compiled_rows_are_those_of_the_interpreter(plant, disturb, rows_of, dry):
    planted = plant(noise=0.5, cameras=2, interfaces=2)
    state, refine = disturb(planted.truth), ("focal", "radial", *OF_SURFACES)
    state = replace(state, dry=torch.arange(len(state.points)) % 3 == 0) if dry else state

    rows, cost = rows_of(planted, state, refine, compiled=True)

    expected, expected_cost = rows_of(planted, state, refine)
    size = expected.abs().amax(dim=-1, keepdim=True)
    assert_matches(rows / size, expected / size, slack=1e3)
    assert_matches(cost, expected_cost, slack=1e3)


def _assert_weighted_by_loss(rows, cost, plain, loss, scale):
    """That rows have the curvature and the gradient of the loss of `plain` ones, by definition."""
    error = plain[:, -1].T
    rho, weight = robust(error.square().sum(dim=-1), loss, scale)
    curved = torch.einsum("aik, kab, bjk -> kij", plain[:, :-1], curvature_of(error, loss, scale), plain[:, :-1])
    size = curved.abs().amax(dim=(1, 2), keepdim=True).clamp(min=1e-300)
    assert_matches(torch.einsum("aik, ajk -> kij", rows[:, :-1], rows[:, :-1]) / size, curved / size, slack=100.0)
    gradient = weight * (plain[:, :-1] * plain[:, -1:]).sum(dim=0)
    size = gradient.abs().amax().clamp(min=1e-300)
    assert_matches((rows[:, :-1] * rows[:, -1:]).sum(dim=0) / size, gradient / size, slack=100.0)
    assert_matches(cost, 0.5 * rho.sum(), slack=10.0)


def _assert_rows_of_autograd(planted, state, rows_of, refine):
    layout = planted.layout(refine)

    rows, _ = rows_of(planted, state, refine, loss="squared")

    seen = planted.observations
    expected = jacobian_of(lambda at: errors_of(at, seen).flatten(), layout, state)
    size = expected.abs().amax(dim=0).clamp(min=1.0)
    assert_matches(dense_jacobian(layout, seen, rows) / size, expected / size, slack=100.0)


@every_loss
def test_noise_divides_errors_before_the_loss_sees_them(plant, disturb, rows_of, draw, loss):
    planted = plant(points=8)
    state, noise = disturb(planted.truth), draw.uniform(0.5, 4.0, len(planted.observations))
    noisy = replace(planted, observations=replace(planted.observations, noise=noise))
    options = {"loss": loss, "loss_scale": 0.3}

    rows, cost = rows_of(noisy, state, ("focal",), **options)

    plain, _ = rows_of(planted, state, ("focal",), loss="squared")
    _assert_weighted_by_loss(rows, cost, plain / noise, loss, 0.3)
