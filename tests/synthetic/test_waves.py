"""Waves: how steep they are, where rays meet them, and Snell's law at the local normal."""

import math

import pytest
import torch

from torchrefrac.camera import Intrinsics, RefractiveCamera
from torchrefrac.refraction import FlatInterface
from torchrefrac.synthetic.options import WaveOptions
from torchrefrac.synthetic.sight import see
from torchrefrac.synthetic.waves import Waves

INDEX_RATIO = 1.333


@pytest.fixture
def waves():
    return Waves.draw(WaveOptions(rms_slope=0.1, longest=40.0, components=6), seed=3)


@pytest.fixture
def rays(draw):
    """A centre above the crests, and unit directions up to 50 degrees from straight down."""
    tilted = draw.uniform(-0.8, 0.8, 500, 2)
    directions = torch.cat((tilted, -torch.ones(500, 1, dtype=torch.float64)), dim=-1)
    return torch.tensor((3.0, -5.0, 30.0), dtype=torch.float64), torch.nn.functional.normalize(directions, dim=-1)


def test_calm_water_has_no_waves():
    assert Waves.draw(WaveOptions(), seed=1) is None


def test_slopes_have_the_root_mean_square_that_was_asked_for(waves, draw):
    _, slope = waves.surface(draw.uniform(-4000.0, 4000.0, 200_000, 2))

    assert float(slope.square().sum(dim=-1).mean().sqrt()) == pytest.approx(0.1, rel=0.02)


def test_waves_that_stand_still_are_the_same_at_all_moments(waves):
    assert waves.at(7) is waves


def test_moving_waves_have_other_phases_at_every_moment(draw):
    moving = Waves.draw(WaveOptions(rms_slope=0.1, longest=40.0, components=6, moving=True), seed=3)
    places = draw.uniform(-4000.0, 4000.0, 100_000, 2)

    first, second = (moving.at(moment).surface(places)[1] for moment in (0, 1))

    assert torch.equal(moving.at(1).surface(places)[1], second)
    assert float(second.square().sum(dim=-1).mean().sqrt()) == pytest.approx(0.1, rel=0.02)
    assert float((first * second).sum(dim=-1).mean()) == pytest.approx(0.0, abs=0.006)


def test_the_gradient_is_the_derivative_of_the_height(waves, draw):
    places = draw.uniform(-50.0, 50.0, 30, 2).requires_grad_()

    height, slope = waves.surface(places)

    assert torch.allclose(torch.autograd.grad(height.sum(), places)[0], slope, atol=1e-12)


def test_lengths_lie_between_the_longest_and_an_eighth_of_it(waves):
    length = 2.0 * math.pi / waves.number.norm(dim=-1)

    assert float(length.max()) <= 40.0
    assert float(length.min()) >= 5.0


def test_rays_enter_on_the_surface(waves, rays):
    center, directions = rays

    entry = waves.enter(center, directions, INDEX_RATIO)

    points = center + entry.length[:, None] * directions
    assert bool(entry.valid.all())
    assert torch.allclose(points[:, 2], waves.surface(points[:, :2])[0], rtol=0.0, atol=1e-9)


def test_rays_bend_by_snells_law_at_the_local_normal(waves, rays):
    center, directions = rays

    entry = waves.enter(center, directions, INDEX_RATIO)

    _, slope = waves.surface((center + entry.length[:, None] * directions)[:, :2])
    normal = torch.nn.functional.normalize(torch.cat((-slope, torch.ones(500, 1).double()), dim=-1), dim=-1)
    in_air, in_water = (torch.linalg.cross(normal, way) for way in (directions, entry.direction))
    assert torch.allclose(in_air, INDEX_RATIO * in_water, atol=1e-12)
    assert torch.allclose(entry.direction.norm(dim=-1), torch.ones(500).double())
    assert bool(((entry.direction * normal).sum(dim=-1) < 0.0).all())
    assert torch.allclose(entry.cosine, -(normal * directions).sum(dim=-1))


def test_rays_that_rise_or_are_nearly_level_do_not_enter(waves):
    directions = torch.nn.functional.normalize(
        torch.tensor(((1.0, 0.0, 0.2), (1.0, 0.0, 0.0), (1.0, 0.0, -1e-9)), dtype=torch.float64), dim=-1
    )

    entry = waves.enter(torch.tensor((0.0, 0.0, 30.0), dtype=torch.float64), directions, INDEX_RATIO)

    assert not entry.valid[:2].any()
    assert all(bool(part.isfinite().all()) for part in entry)


def test_waves_without_height_are_flat_water(stage, draw, waves):
    flat = Waves(waves.number, 0.0 * waves.amplitude, waves.phase)
    lens = Intrinsics.create(400, 300, 300.0)
    camera = RefractiveCamera(lens, stage.rotation[0], stage.center[0], FlatInterface(INDEX_RATIO))
    pixels = draw.uniform(0.0, 300.0, 500, 2)

    calm, wavy = (see(stage.pieces, camera, pixels, w) for w in (None, flat))

    assert torch.equal(calm.piece, wavy.piece)
    assert torch.allclose(calm.points, wavy.points, rtol=0.0, atol=1e-9, equal_nan=True)


def test_waves_depend_on_the_seed():
    options = WaveOptions(rms_slope=0.1)

    first, again, other = (Waves.draw(options, seed) for seed in (1, 1, 2))

    assert torch.equal(first.number, again.number)
    assert not torch.equal(first.number, other.number)
