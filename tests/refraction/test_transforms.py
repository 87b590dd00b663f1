"""Refraction under `torch.func`, the compiler, autocast, and in half precision."""

from functools import partial

import pytest
import torch
from torch.func import hessian, jacfwd, jacrev, vmap

from tests.refraction.interfaces import INTERFACES, cameras_before, points_behind
from tests.tolerances import assert_matches
from torchrefrac.refraction import FlatInterface, lift_points, refract_rays, solve_refrax, water_index

HALF = [torch.float16, torch.bfloat16]
GOOD = (1.0, 0.7, 2.0, 1.333)


def test_the_refrax_ratio_runs_under_vmap(draw):
    case = _cases(draw, 3, 4)

    nested = vmap(vmap(solve_refrax))(*case)

    assert_matches(nested, solve_refrax(*case))
    assert_matches(vmap(solve_refrax, in_dims=(0, None, 0, None))(case[0], 0.7, case[2], 1.333), _with_numbers(case))


@pytest.mark.parametrize("transform", [jacrev, jacfwd])
def test_jacobians_of_the_refrax_ratio_are_its_gradients(draw, transform):
    case = [value.requires_grad_() for value in _cases(draw, 6)]
    gradients = torch.autograd.grad(solve_refrax(*case).sum(), case)

    jacobians = vmap(transform(solve_refrax, argnums=(0, 1, 2, 3)))(*(value.detach() for value in case))

    for jacobian, gradient in zip(jacobians, gradients, strict=True):
        assert_matches(jacobian, gradient)


def test_the_hessian_of_the_refrax_ratio_is_that_of_autograd(draw):
    case = torch.stack(_cases(draw, 6), dim=-1)

    def ratio(x):
        return solve_refrax(*x.unbind(dim=-1))

    by_transform = vmap(hessian(ratio))(case)

    by_autograd = torch.stack([torch.autograd.functional.hessian(ratio, x) for x in case])
    assert_matches(by_transform, by_autograd)


@pytest.mark.parametrize("name", ["water", "glass wall", "looking out through glass", "air gap"])
def test_lifted_points_have_the_derivatives_of_autograd_under_every_transform(draw, name):
    interface = INTERFACES[name]
    center, points = cameras_before(draw, interface, 4), points_behind(draw, interface, 4)

    def offset(center, point):
        return lift_points(center, point, interface)[0]

    def depth(center, point):
        return offset(center, point)[2]

    pairs = list(zip(center, points, strict=True))
    first = torch.stack([torch.autograd.functional.jacobian(partial(offset, c), p) for c, p in pairs])
    second = torch.stack([torch.autograd.functional.hessian(partial(depth, c), p) for c, p in pairs])
    assert_matches(vmap(offset)(center, points), offset(center, points))
    assert_matches(vmap(jacrev(offset, argnums=1))(center, points), first)
    assert_matches(vmap(jacfwd(offset, argnums=1))(center, points), first)
    assert_matches(vmap(hessian(depth, argnums=1))(center, points), second, slack=10.0)


def test_an_interface_may_be_built_inside_a_transform(draw):
    index, thickness = draw.uniform(1.1, 1.5, 5, 3), draw.uniform(0.1, 0.3, 5, 1)
    center = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    point = torch.tensor([0.5, 0.3, -1.0], dtype=torch.float64)

    def height(index, thickness):
        interface = FlatInterface(layers=index, thickness=thickness)
        return lift_points(center, point, interface)[0][2], refract_rays(center, point - center, interface)[0]

    for mapped, alone in zip(vmap(height)(index, thickness), height(index[3], thickness[3]), strict=True):
        assert_matches(mapped[3], alone)


def test_forward_mode_without_a_transform_passes_through_a_batch_of_any_size():
    height = torch.linspace(1.0, 2.0, 50_000, dtype=torch.float64)
    with torch.autograd.forward_ad.dual_level():
        dual = torch.autograd.forward_ad.make_dual(height, torch.ones_like(height))
        tangent = torch.autograd.forward_ad.unpack_dual(solve_refrax(dual, 0.7, 2.0, 1.333)).tangent

    few = height[::5000].clone().requires_grad_()
    (expected,) = torch.autograd.grad(solve_refrax(few, 0.7, 2.0, 1.333).sum(), few)
    assert_matches(tangent[::5000], expected)


@pytest.mark.parametrize(("which", "bad"), [(0, 0.0), (1, -1.0), (2, -1.0), (3, 0.9), (3, float("nan"))], ids=str)
def test_a_bad_value_is_refused_inside_vmap_too(which, bad):
    values = [torch.full((3,), value) for value in GOOD]
    values[which][1] = bad

    with pytest.raises(ValueError, match="must be finite"):
        vmap(solve_refrax)(*values)


def test_a_bad_interface_is_refused_inside_vmap_too():
    with pytest.raises(ValueError, match=r"index_ratio is 0\.9, but must be finite and at least 1"):
        vmap(lambda n: FlatInterface(n).index_like(n))(torch.tensor([1.333, 0.9]))


def test_the_compiled_refrax_ratio_and_its_gradient_are_those_of_eager_mode(draw):
    case = _cases(draw, 7)
    compiled = torch.compile(solve_refrax, fullgraph=True, backend="aot_eager")
    inputs = [value.requires_grad_() for value in case]

    ratio = compiled(*inputs)

    expected = solve_refrax(*inputs)
    assert_matches(ratio, expected)
    for gradient, wanted in zip(
        torch.autograd.grad(ratio.sum(), inputs), torch.autograd.grad(expected.sum(), inputs), strict=True
    ):
        assert_matches(gradient, wanted)


def test_autocast_changes_no_bit_of_the_refrax_ratio_and_its_gradient(draw):
    results = []
    for enabled in (False, True):
        inputs = [value.float().requires_grad_() for value in _cases(type(draw)(torch.Generator().manual_seed(1)), 50)]
        with torch.autocast("cpu", dtype=torch.bfloat16, enabled=enabled):
            ratio = solve_refrax(*inputs)
            results.append((ratio, *torch.autograd.grad(ratio.sum(), inputs)))

    for without, within in zip(*results, strict=True):
        assert within.dtype == torch.float32
        assert torch.equal(within, without)


@pytest.mark.parametrize("name", ["glass wall", "air gap"])
def test_autocast_changes_no_bit_of_lifted_points_and_cast_rays(draw, name):
    interface = INTERFACES[name].to(dtype=torch.float32)
    center, points = cameras_before(draw, interface, 50).float(), points_behind(draw, interface, 50).float()
    offset, _ = lift_points(center, points, interface)
    rays = refract_rays(center, offset, interface)

    with torch.autocast("cpu", dtype=torch.bfloat16):
        offset_within, _ = lift_points(center, points, interface)
        rays_within = refract_rays(center, offset, interface)

    assert torch.equal(offset_within, offset)
    for within, without in zip(rays_within, rays, strict=True):
        assert torch.equal(within, without)


@pytest.mark.parametrize("dtype", HALF)
def test_half_precision_is_raised_to_single(dtype):
    inputs = [torch.tensor([value], dtype=dtype) for value in GOOD]

    ratio = solve_refrax(*inputs)

    assert ratio.dtype == torch.float32
    assert torch.equal(ratio, solve_refrax(*(value.float() for value in inputs)))
    assert solve_refrax(inputs[0], *GOOD[1:]).dtype == torch.float32


def test_the_widest_dtype_of_the_arguments_is_that_of_the_ratio():
    single, double = torch.ones(1, dtype=torch.float32), torch.ones(1, dtype=torch.float64)

    assert solve_refrax(single, 1.0, double, 1.333).dtype == torch.float64
    assert solve_refrax(single, 1.0, 1.0, 1.333).dtype == torch.float32


def test_the_index_of_water_runs_under_transforms(draw):
    temperature = draw.uniform(0.0, 30.0, 5)
    values = temperature.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(water_index(values, 35.0).sum(), values)

    slope = vmap(jacfwd(lambda t: water_index(t, 35.0)))(temperature)

    assert_matches(slope, gradient)
    with pytest.raises(ValueError, match="temperature_c is 31, but must be finite"):
        vmap(water_index)(torch.tensor([20.0, 31.0]))


def _cases(draw, *shape):
    """Heights, depths, distances and index ratios, nadir and index ratio 1 left out."""
    ranges = ((0.5, 2.0), (0.1, 2.0), (0.1, 5.0), (1.05, 2.0))
    return [draw.uniform(low, high, *shape) for low, high in ranges]


def _with_numbers(case):
    return solve_refrax(case[0], 0.7, case[2], 1.333)
