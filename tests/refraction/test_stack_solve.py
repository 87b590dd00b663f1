"""What is seen through several layers, the camera in any of the media: against slow solvers of Snell's law."""

import pytest
import torch

from tests.refraction.stacks import Stack, make_stack, solve_by_bracketing
from tests.tolerances import TOLERANCE

MEDIA = [2, 3, 4, 5]


@pytest.mark.parametrize("media", MEDIA)
def test_the_apparent_height_is_the_bracketed_root_of_snells_law(draw, media):
    stack = make_stack(draw, _any_index(draw, media, 1000))

    seen = stack.apparent_height

    crossed = stack.crossed.T.astype(float).tolist()
    oracle = map(solve_by_bracketing, crossed, stack.index.T.tolist(), stack.distance.tolist())
    torch.testing.assert_close(seen, torch.tensor([*oracle], dtype=torch.float64), rtol=1e-12, atol=0.0)


@pytest.mark.parametrize("thin", [False, True], ids=["any thickness", "a film of the rarest"])
@pytest.mark.parametrize("media", MEDIA)
def test_the_apparent_height_is_exact_to_twelve_digits(draw, media, thin):
    stack = make_stack(draw, _any_index(draw, media, 10_000), thin=thin and media > 2)

    assert stack.worst_error() < 1e-12


@pytest.mark.parametrize("media", MEDIA)
def test_a_camera_in_air_sees_through_layers_as_precisely_as_through_one_surface(draw, media):
    index = 1.0 + draw.power_of_ten(-3.0, 0.17, media, 10_000)
    index[0] = 1.0

    stack = make_stack(draw, index)

    assert stack.worst_error() < TOLERANCE[torch.float64].solve


@pytest.mark.parametrize("media", MEDIA)
def test_in_single_precision_only_the_sum_of_thicknesses_costs_a_camera_in_air_more(draw, media):
    index = 1.0 + draw.power_of_ten(-3.0, 0.17, media, 10_000)
    index[0] = 1.0

    stack = make_stack(draw, index).to(torch.float32)

    assert stack.worst_error() < TOLERANCE[torch.float32].solve * (1.0 if media == 2 else 5.0)


@pytest.mark.parametrize("media", MEDIA)
def test_media_of_nearly_the_same_index_cost_no_more_than_the_rounding_of_their_ratio(draw, media):
    base = torch.tensor([1.0, 1.1, 1.333, 1.52], dtype=torch.float64)
    near = base[draw.uniform(0.0, 4.0, media, 10_000).long()]
    nearly = near * (
        1.0 + draw.power_of_ten(-13.0, -1.0, media, 10_000) * (draw.uniform(0.0, 1.0, media, 10_000) < 0.5)
    )

    stack = make_stack(draw, nearly)

    assert stack.worst_error() < 2e-10  # the square of tan(89.9 deg), times the rounding


def test_a_film_of_air_in_water_is_seen_through_from_outside_its_critical_cone(draw):
    height = draw.power_of_ten(-1.0, 1.0, 2000)
    index = torch.tensor([[1.333], [1.0], [1.333]], dtype=torch.float64).expand(3, 2000)
    steeper = 2.0 * height * draw.uniform(1.2, 10.0, 2000)  # the critical angle has the tangent 1.13

    stack = Stack(index, 1e-6 * height[None], height, height, steeper)

    assert stack.worst_error() < 1e-12


def _any_index(draw, media, count):
    """Hundredths from 1 to 2.5 in any order; one in six is that of the medium before."""
    index = 1.0 + draw.uniform(0.0, 150.0, media, count).round() / 100.0
    same = draw.uniform(0.0, 1.0, media, count) < 1.0 / 6.0
    for i in range(1, media):
        index[i] = torch.where(same[i], index[i - 1], index[i])
    return index
