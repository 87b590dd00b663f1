"""Viewing rays bent at the water surface."""

import pytest
import torch

from tests.tolerances import DTYPES, assert_matches
from torchrefrac.refraction import FlatInterface, refract_rays

WATER = FlatInterface(torch.tensor(1.333, dtype=torch.float64))
AIR = FlatInterface(torch.tensor(1.0, dtype=torch.float64))


def test_the_refrax_is_where_the_viewing_ray_meets_the_surface(draw):
    center, direction = _downward(draw, 200)

    refrax, _, valid = refract_rays(center, direction, WATER)

    assert valid.all()
    assert torch.equal(refrax[:, 2], torch.zeros(200, dtype=torch.float64))
    along = center[:, 2:] / -direction[:, 2:]
    assert_matches(refrax, center + along * direction, slack=100.0)


def test_the_ray_bends_by_snells_law_in_vector_form(draw):
    center, direction = _downward(draw, 200)
    index = draw.uniform(1.0, 2.5, 200)

    _, bent, _ = refract_rays(center, direction, FlatInterface(index))

    unit, up = torch.nn.functional.normalize(direction, dim=-1), direction.new_tensor((0.0, 0.0, 1.0))
    cosine, r = -unit[:, 2:], 1.0 / index[:, None]
    expected = r * unit + (r * cosine - (1.0 - r**2 * (1.0 - cosine**2)).sqrt()) * up
    assert_matches(bent, expected, slack=10.0)


@pytest.mark.parametrize("dtype", DTYPES)
def test_the_direction_in_the_water_has_length_one(draw, dtype):
    center, direction = (value.to(dtype) for value in _downward(draw, 2, 100))

    _, bent, _ = refract_rays(center, direction, WATER.to(dtype=dtype))

    assert_matches(bent.norm(dim=-1), torch.ones(2, 100, dtype=dtype))


def test_the_length_of_the_direction_does_not_matter(draw):
    center, direction = _downward(draw, 200)

    for once, scaled in zip(
        refract_rays(center, direction, WATER)[:2], refract_rays(center, 1e3 * direction, WATER)[:2], strict=True
    ):
        assert_matches(scaled, once, slack=100.0)


@pytest.mark.parametrize("incidence_deg", [0.0, 30.0, 80.0, 89.0, 89.9])
def test_at_index_ratio_one_the_ray_goes_straight_on(draw, incidence_deg):
    angle, azimuth = torch.deg2rad(torch.tensor(incidence_deg, dtype=torch.float64)), draw.uniform(-3.0, 3.0, 50)
    horizontal = angle.sin() * torch.stack((azimuth.cos(), azimuth.sin()), dim=-1)
    unit = torch.cat((horizontal, -angle.cos().expand(50, 1)), dim=-1)

    _, bent, valid = refract_rays(torch.ones(50, 3, dtype=torch.float64), unit, AIR)

    assert valid.all()
    torch.testing.assert_close(bent, unit, rtol=1e-12, atol=1e-15)


def test_rays_that_do_not_meet_the_water_are_masked_and_returned_as_they_came(draw):
    center, direction = _downward(draw, 3)
    direction[0, 2] = direction[0, 2].abs()  # upwards
    direction[1, 2] = 0.0  # level
    center[2, 2] = -1.0  # from below the surface

    origin, onward, valid = refract_rays(center, direction, WATER)

    assert not valid.any()
    assert torch.equal(origin, center)
    assert_matches(onward, torch.nn.functional.normalize(direction, dim=-1))


def test_centres_directions_and_index_ratios_broadcast(draw):
    center, direction = _downward(draw, 4)
    index = draw.uniform(1.1, 1.5, 2, 1, 1)

    refrax, bent, valid = refract_rays(center[:3, None], direction, FlatInterface(index))

    assert refrax.shape == bent.shape == (2, 3, 4, 3)
    assert valid.shape == (2, 3, 4)
    one = FlatInterface(index[1, 0, 0])
    for grid, alone in zip((refrax, bent), refract_rays(center[2], direction[3], one)[:2], strict=True):
        assert_matches(grid[1, 2, 3], alone)


@pytest.mark.parametrize("interface", [AIR, WATER], ids=["air", "water"])
def test_gradients_stay_finite_where_a_ray_is_level(interface):
    center = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64, requires_grad=True)
    direction = torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64, requires_grad=True)

    refrax, bent, _ = refract_rays(center, direction, interface)
    (refrax.sum() + bent.sum()).backward()

    assert center.grad.isfinite().all()
    assert direction.grad.isfinite().all()


def test_rays_are_differentiable_in_centre_direction_and_index_ratio(draw):
    center, direction = _downward(draw, 3)
    direction[0] = direction.new_tensor((0.0, 0.0, -1.0))
    inputs = [value.requires_grad_() for value in (center, direction, draw.uniform(1.1, 1.5, 3))]

    def refract(center, direction, index):
        return refract_rays(center, direction, FlatInterface(index))[:2]

    assert torch.autograd.gradcheck(refract, inputs, check_forward_ad=True)


def _downward(draw, *shape):
    """Centres above the water and directions of any length that go down at up to 80 degrees from the vertical."""
    center = torch.cat((draw.normal(*shape, 2), draw.uniform(0.5, 3.0, *shape, 1)), dim=-1)
    angle, azimuth = torch.deg2rad(draw.uniform(0.0, 80.0, *shape)), draw.uniform(-3.0, 3.0, *shape)
    unit = torch.stack((angle.sin() * azimuth.cos(), angle.sin() * azimuth.sin(), -angle.cos()), dim=-1)
    return center, unit * draw.power_of_ten(-2.0, 2.0, *shape, 1)
