"""What sensors say of attitude and position: signs by hand, errors by their statistics."""

import math
from dataclasses import replace

import pytest
import torch

from torchrefrac.synthetic.attitude import measure_attitude, measure_positions
from torchrefrac.synthetic.options import InertialOptions

EXACT = InertialOptions(gravity_sigma_deg=0.0, heading_sigma_deg=0.0)
DOWNWARDS = torch.diag(torch.tensor((1.0, -1.0, -1.0), dtype=torch.float64))
EASTWARDS = torch.tensor([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]], dtype=torch.float64)


def test_exact_sensors_tell_the_truth(stage, options):
    said = measure_attitude(stage.rotation, replace(options, inertial=EXACT))

    assert torch.allclose(said.down_in_cam, -stage.rotation[..., 2])
    assert torch.allclose(said.true_down, -stage.rotation[..., 2])
    assert said.sigma_deg == 0.05


def test_the_heading_is_that_of_the_images_top_clockwise_from_north(options):
    said = measure_attitude(torch.stack((DOWNWARDS, EASTWARDS)), replace(options, inertial=EXACT))

    assert said.heading.rad2deg().tolist() == pytest.approx([0.0, 90.0])


def test_a_tilted_plane_turns_gravity_the_same_way_in_the_world(stage, options):
    said = measure_attitude(stage.rotation, replace(options, inertial=EXACT, plane_tilt_deg=(4.0, 0.0)))

    down = (stage.rotation.mT @ said.true_down[..., None])[..., 0]
    angle = math.radians(4.0)
    wanted = torch.tensor((0.0, math.sin(angle), -math.cos(angle)), dtype=torch.float64)
    assert torch.allclose(down, wanted.expand_as(down))
    assert torch.allclose(said.down_in_cam, said.true_down)
    assert said.sigma_deg == pytest.approx(4.0 / math.sqrt(2.0))


def test_a_bias_turns_gravity_the_same_way_in_all_cameras(options):
    inertial = replace(EXACT, gravity_bias_deg=(3.0, 0.0))

    said = measure_attitude(torch.stack((DOWNWARDS, EASTWARDS)), replace(options, inertial=inertial))

    angle = math.radians(3.0)
    wanted = torch.tensor((0.0, -math.sin(angle), math.cos(angle)), dtype=torch.float64)
    assert torch.allclose(said.down_in_cam, wanted.expand(2, 3))
    assert torch.allclose(said.true_down[:, 2], torch.ones(2).double())


def test_errors_have_their_standard_deviations(options, draw):
    rotation = draw.rotations(4000)
    inertial = InertialOptions(gravity_sigma_deg=1.5, heading_sigma_deg=4.0)

    said = measure_attitude(rotation, replace(options, inertial=inertial))
    exact = measure_attitude(rotation, replace(options, inertial=EXACT))

    assert torch.allclose(said.down_in_cam.norm(dim=-1), torch.ones(4000).double())
    angle = torch.linalg.cross(said.down_in_cam, said.true_down).norm(dim=-1).asin().rad2deg()
    assert float((angle.square().mean() / 2).sqrt()) == pytest.approx(1.5, rel=0.03)
    assert float((said.heading - exact.heading).rad2deg().std()) == pytest.approx(4.0, rel=0.05)
    assert said.sigma_deg == 1.5


def test_without_a_compass_there_is_no_heading(stage, options):
    inertial = InertialOptions(heading_sigma_deg=None)

    assert measure_attitude(stage.rotation, replace(options, inertial=inertial)).heading is None


def test_positions_err_by_their_sigma_and_depend_on_the_seed():
    center = torch.zeros(5000, 3, dtype=torch.float64)

    first, again, other = (measure_positions(center, 2.0, seed) for seed in (1, 1, 2))

    assert torch.equal(first, again)
    assert not torch.equal(first, other)
    assert float(first.std()) == pytest.approx(2.0, rel=0.03)
