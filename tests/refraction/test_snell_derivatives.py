"""Derivatives of the Snell solve, also where it degenerates: nadir, grazing, depth 0, index ratio 1."""

import math

import pytest
import torch

from tests.tolerances import assert_matches
from torchrefrac.refraction import apparent_height, apparent_height_partials, solve_refrax

PLACES = {  # height, depth, distance, index ratio
    "oblique": (1.3, 0.7, 2.0, 1.333),
    "nadir": (1.3, 0.7, 0.0, 1.333),
    "grazing": (1.3, 0.7, 1.3 * math.tan(math.radians(89.0)), 1.333),
    "index ratio 1": (1.3, 0.7, 2.0, 1.0),
    "on the surface": (1.3, 0.0, 2.0, 1.333),
    "nadir on the surface at index ratio 1": (1.3, 0.0, 0.0, 1.0),
}
ARGUMENTS = ("height", "depth", "distance", "index_ratio")
BORDER = {"depth": 0.0, "distance": 0.0, "index_ratio": 1.0}
at_every_place = pytest.mark.parametrize("place", PLACES.values(), ids=PLACES.keys())


@at_every_place
@pytest.mark.parametrize("method", ["halley", "newton"])
def test_apparent_height_has_the_right_first_derivatives(place, method):
    inputs = _with_squared_distance(place)

    assert torch.autograd.gradcheck(lambda *x: _of_one_surface(*x, method), inputs, check_forward_ad=True)


@at_every_place
def test_apparent_height_has_the_right_second_derivatives(place):
    assert torch.autograd.gradgradcheck(_of_one_surface, _with_squared_distance(place))


@at_every_place
def test_partials_in_closed_form_are_those_of_autograd(place):
    inputs = distance_sq, height, depth, index = _with_squared_distance(place)
    apparent = _of_one_surface(*inputs)

    partials = apparent_height_partials(apparent, distance_sq, height, (depth,), (index,))

    in_closed_form = (partials.by_distance_sq, partials.by_clear, *partials.by_thickness, *partials.by_index)
    for partial, gradient in zip(in_closed_form, torch.autograd.grad(apparent, inputs), strict=True):
        assert_matches(partial, gradient)


@at_every_place
def test_refrax_ratio_has_the_right_first_and_second_derivatives_inside_its_domain(place):
    inside = [name for name, value in zip(ARGUMENTS, place, strict=True) if value != BORDER.get(name)]
    inputs = [
        torch.tensor(value, dtype=torch.float64, requires_grad=name in inside)
        for name, value in zip(ARGUMENTS, place, strict=True)
    ]

    assert torch.autograd.gradcheck(solve_refrax, inputs)
    assert torch.autograd.gradgradcheck(solve_refrax, inputs)


@at_every_place
@pytest.mark.parametrize("name", ARGUMENTS)
def test_derivative_of_the_refrax_ratio_is_its_slope_into_the_domain(place, name):
    which, step = ARGUMENTS.index(name), 1e-5
    inputs = torch.tensor(place, dtype=torch.float64, requires_grad=True)

    gradient = torch.autograd.grad(solve_refrax(*inputs), inputs)[0][which]

    ahead = torch.tensor([place, place, place], dtype=torch.float64)
    ahead[:, which] += step * torch.arange(3.0)
    f0, f1, f2 = solve_refrax(*ahead.unbind(dim=-1))
    torch.testing.assert_close(gradient, (-3.0 * f0 + 4.0 * f1 - f2) / (2.0 * step), rtol=1e-6, atol=1e-8)


def test_the_derivatives_do_not_depend_on_the_method():
    gradients = []
    for method in ("halley", "newton", "companion"):
        inputs = torch.tensor(PLACES["oblique"], dtype=torch.float64, requires_grad=True)
        gradients.append(torch.autograd.grad(solve_refrax(*inputs, method=method), inputs)[0])

    assert_matches(gradients[1], gradients[0])
    assert_matches(gradients[2], gradients[0], slack=100.0)


def test_gradients_are_finite_and_exact_in_single_precision_at_nadir():
    inputs = torch.tensor(PLACES["nadir"], dtype=torch.float32, requires_grad=True)

    gradient = torch.autograd.grad(solve_refrax(*inputs), inputs)[0]

    height, depth, _, index = PLACES["nadir"]
    apparent = height + depth / index
    expected = [
        depth / index / apparent**2,
        -height / index / apparent**2,
        0.0,
        height * depth / (index * apparent) ** 2,
    ]
    assert_matches(gradient, torch.tensor(expected))


def test_apparent_height_and_its_gradient_run_under_vmap(draw):
    inputs = [draw.uniform(low, high, 5, 4) for low, high in ((0.0, 9.0), (1.0, 2.0), (0.0, 2.0), (1.0, 1.5))]
    for value in inputs:
        value.requires_grad_()
    batched = _of_one_surface(*inputs)

    assert_matches(torch.func.vmap(_of_one_surface)(*inputs), batched)
    by_element = torch.func.grad(_of_one_surface, argnums=(0, 1, 2, 3))
    gradients = torch.func.vmap(torch.func.vmap(by_element))(*inputs)
    for gradient, expected in zip(gradients, torch.autograd.grad(batched.sum(), inputs), strict=True):
        assert_matches(gradient, expected)


def _of_one_surface(distance_sq, height, depth, index, method="halley"):
    return apparent_height(distance_sq, height, (depth,), (index,), method)


def _with_squared_distance(place):
    height, depth, distance, index = place
    return [torch.tensor(x, dtype=torch.float64, requires_grad=True) for x in (distance**2, height, depth, index)]
