"""The window's three places that carry its plane."""

import math

import pytest
import torch

from tests.tolerances import assert_matches
from torchrefrac.dense.window import Window

for_every_window = pytest.mark.parametrize(
    "window", [Window(3), Window(5, 0.5), Window(), Window(9, 4.0)], ids=["3", "5 narrow", "7", "9 wide"]
)


@for_every_window
def test_samples_are_a_square_lattice_around_the_centre(window):
    steps = [window.spacing * (i - (window.size - 1) / 2) for i in range(window.size)]

    assert window.offsets.tolist() == [[x, y] for y in steps for x in steps]


@for_every_window
def test_corners_lie_at_the_root_mean_square_distance_of_the_samples_and_a_third_of_a_turn_apart(window):
    distances = [math.hypot(x, y) for x, y in window.offsets.tolist()]
    rms = math.sqrt(sum(d * d for d in distances) / len(distances))

    assert window.radius == pytest.approx(rms, rel=1e-14)
    assert_matches(window.corners.norm(dim=-1), torch.full((3,), rms, dtype=torch.float64))
    assert_matches(window.corners.sum(dim=0), torch.zeros(2, dtype=torch.float64))
    assert_matches((window.corners @ window.corners.T)[0, 1:], torch.full((2,), -0.5 * rms**2, dtype=torch.float64))


@for_every_window
def test_weights_carry_any_affine_map_from_the_corners_to_the_samples(draw, window):
    matrix, shift = draw.normal(20, 2, 2), draw.normal(20, 1, 2)

    samples = window.weights @ (window.corners @ matrix.mT + shift)

    assert_matches(samples, window.offsets @ matrix.mT + shift, slack=10.0)
    assert_matches(window.weights.sum(dim=1), torch.ones(window.size**2, dtype=torch.float64))


@for_every_window
def test_places_do_what_the_weights_do(draw, window):
    corners = draw.normal(20, 3, 2)

    samples = (corners.flatten(1) @ window.places).unflatten(1, (-1, 2))

    assert_matches(samples, window.weights @ corners)


@for_every_window
def test_outer_takes_the_corners_to_the_four_outermost_samples(window):
    reach = window.spacing * (window.size - 1) / 2

    outermost = (window.corners.flatten() @ window.outer).view(4, 2)

    expected = [(-reach, -reach), (reach, -reach), (-reach, reach), (reach, reach)]
    assert_matches(outermost, torch.tensor(expected, dtype=torch.float64))


@for_every_window
def test_the_squared_basis_changes_the_variables_of_a_quadratic_form(draw, window):
    rows = draw.normal(20, 3)

    in_distances, in_states = (v[:, :, None] * v[:, None, :] for v in (rows, rows @ window.basis))

    assert_matches((in_distances.flatten(1) @ window.squared_basis).view(20, 3, 3), in_states)


@for_every_window
def test_three_distances_are_those_of_a_plane_with_a_slope_over_one_radius(draw, window):
    distance, slope = draw.normal(), draw.normal(2)

    at_corners = window.basis @ torch.cat((distance[None], slope))

    assert_matches(at_corners, distance + window.corners @ slope / window.radius)


@for_every_window
def test_a_curved_warp_shifts_the_window_as_a_whole_by_nothing(draw, window):
    """Any quadratic; with corners elsewhere than at the RMS radius it would shift it."""
    form, linear, shift = draw.normal(20, 1, 2, 2), draw.normal(20, 1, 2), draw.normal(20, 1)

    def warp(at):
        return (at[..., None, :] @ form @ at[..., :, None])[..., 0, 0] + (at * linear).sum(dim=-1) + shift

    error = warp(window.corners.expand(20, 3, 2)) @ window.weights.T - warp(window.offsets.expand(20, -1, 2))
    elsewhere = warp(1.2 * window.corners.expand(20, 3, 2)) @ window.weights.T - warp(window.offsets.expand(20, -1, 2))

    scale = window.radius**2
    torch.testing.assert_close(error.mean(dim=1) / scale, torch.zeros(20).double(), rtol=0.0, atol=1e-13)
    assert error.abs().amax(dim=1).min() > 1e-2 * scale
    assert (elsewhere.mean(dim=1).abs() / scale).median() > 0.05
