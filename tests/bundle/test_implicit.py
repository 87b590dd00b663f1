"""Gradients through the adjustment: by the implicit function theorem on a cost by definition; finite differences."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import pytest
import torch
from torch import Tensor
from torch.autograd import gradcheck

from tests.bundle.bundle_oracles import errors_of, moved, num_unknowns
from tests.bundle.changes import changed, tensor_of
from torchrefrac.bundle import (
    BundleOptions,
    BundleProblem,
    CenterPrior,
    Expectations,
    GravityPrior,
    HeightPrior,
    KnownPoints,
    ScaleBars,
    Term,
    UnadjustableError,
    adjust,
    adjust_differentiably,
)
from torchrefrac.bundle.layout import Layout
from torchrefrac.optim import LevenbergMarquardtOptions, robust
from torchrefrac.scene import Scene

TIGHT = LevenbergMarquardtOptions(max_iterations=100, function_tolerance=1e-13, initial_damping=1e-10)
SQUARED = BundleOptions(loss="squared", pixel_sigma=0.5, solver=TIGHT)
CAUCHY = replace(SQUARED, loss="cauchy", loss_scale=2.0)
ONE = torch.ones(1, dtype=torch.float64)


@dataclass(frozen=True)
class Layer:
    """An adjustment as a function of tensors `inputs`: make(start, *inputs) is what is adjusted. start: a solution."""

    make: Callable[..., tuple[Scene, Sequence[Term]]]
    inputs: tuple[Tensor, ...]
    sizes: tuple[float, ...]
    start: Scene
    options: BundleOptions
    fixed: Tensor | None = None

    def __call__(self, *inputs: Tensor) -> Scene:
        state, terms = self.make(self.start, *inputs)
        return adjust_differentiably(state, self.options, terms=terms, fixed=self.fixed)

    @torch.no_grad()
    def problem(self) -> BundleProblem:
        """What is adjusted, from the solution."""
        state, terms = self.make(self.start, *self.inputs)
        return adjust(state, self.options, terms=terms, fixed=self.fixed).problem


def _given(name, planted, draw):
    """A function (state, *inputs) -> what is adjusted, inputs, and what a change of theirs that can be seen is."""
    truth, seen = planted.truth, planted.observations
    bar = torch.tensor([1]), torch.tensor([4])
    length = (truth.points[1] - truth.points[4]).norm()[None] + 0.3
    information = 4.0 * torch.eye(3, dtype=torch.float64).expand(2, 3, 3)
    cameras = truth.cameras

    def pixels(state, pixels):
        return changed(state, observations=replace(seen, pixels=pixels)), [planted.gravity]

    def weights(state, weight):
        return changed(state, observations=replace(seen, weight=weight)), [planted.gravity]

    def priors(state, gravity, position, height):
        terms = [
            GravityPrior(gravity, 0.01),
            CenterPrior(torch.tensor((0, 2)), position, information),
            HeightPrior(torch.tensor([1]), height, 0.5 * ONE),
        ]
        return state, terms

    def control(state, length, sigma, position):
        return state, [ScaleBars(*bar, length, sigma), KnownPoints(torch.tensor((2, 4)), position, information)]

    def intrinsics(state, focal, principal_point, distortion):
        given = {"focal": focal, "principal_point": principal_point, "distortion": distortion}
        return changed(state, **given), [planted.gravity]

    def water(state, index_ratio, tilt, offset):
        normal = torch.nn.functional.normalize(torch.cat((tilt, ONE))[None], dim=-1)
        return changed(state, index_ratio=index_ratio, normal=normal, offset=offset), [planted.gravity]

    def expected(state, index_ratio, pixels):
        seen_here = replace(seen, pixels=pixels)
        return changed(state, index_ratio=index_ratio, observations=seen_here), [planted.gravity]

    none = torch.zeros(1, dtype=torch.float64)
    wanted = {
        "pixels": (pixels, (seen.pixels,), (1.0,)),
        "weights": (weights, (draw.uniform(0.2, 2.0, len(seen)),), (1.0,)),
        "priors": (
            priors,
            (planted.down_in_cam, truth.views.center[[0, 2]] + 0.3, truth.views.center[1:2, 2] - 0.4),
            (0.01, 1.0, 1.0),
        ),
        "control": (control, (length, 0.2 * ONE, truth.points[[2, 4]] + 0.2), (1.0, 1.0, 1.0)),
        "intrinsics": (intrinsics, (cameras.focal, cameras.principal_point, cameras.distortion), (10.0, 10.0, 0.01)),
        "water": (water, (truth.interfaces.index_ratio[0], torch.cat((none, none)), none), (0.01, 0.01, 1.0)),
        "expected": (expected, (truth.interfaces.index_ratio[0] + 0.003, seen.pixels), (0.01, 1.0)),
    }
    return wanted[name]


CASES = {
    "pixels, squared, free": ("pixels", SQUARED, {}),
    "pixels, cauchy, free": ("pixels", CAUCHY, {}),
    "pixels, huber, free": ("pixels", replace(SQUARED, loss="huber", loss_scale=1.0), {}),
    "pixels, air": ("pixels", SQUARED, {"index_ratio": 1.0}),
    "pixels, cauchy, fixed": ("pixels", CAUCHY, {"fixed": True}),
    "weights, cauchy, free": ("weights", CAUCHY, {}),
    "weights, squared, fixed": ("weights", SQUARED, {"fixed": True}),
    "priors": ("priors", CAUCHY, {}),
    "a bar and control points, squared": ("control", SQUARED, {}),
    "a bar and control points, cauchy, fixed": ("control", CAUCHY, {"fixed": True}),
    "intrinsics, squared, free": ("intrinsics", SQUARED, {}),
    "intrinsics, cauchy, fixed": ("intrinsics", CAUCHY, {"fixed": True}),
    "water, squared, free": ("water", SQUARED, {}),
    "water, cauchy, fixed": ("water", CAUCHY, {"fixed": True}),
    "index ratio refined": ("expected", replace(SQUARED, refine=("index_ratio",)), {}),
    "index ratio expected": (
        "expected",
        replace(CAUCHY, refine=("index_ratio",), expected=Expectations(index_ratio=0.01)),
        {},
    ),
    "focal length refined": ("pixels", replace(SQUARED, refine=("focal",)), {}),
}


@pytest.fixture
def layer_of(plant, draw):
    """`layer_of(name)`: of CASES, with half a pixel of noise."""

    def make(name, points=8):
        kind, options, scene = CASES[name]
        scene = dict(scene)
        fixed = None
        if scene.pop("fixed", False):
            fixed = torch.zeros(4, 6, dtype=torch.bool)
            fixed[0] = fixed[2, 3:5] = True
        planted = plant(views=4, points=points, noise=0.5, distortion=(-0.1, 0.05, 1e-3, 0.0, 0.0), **scene)
        build, inputs, sizes = _given(kind, planted, draw)
        layer = Layer(build, inputs, sizes, planted.truth, options, fixed)
        for _ in range(2):
            state, terms = build(layer.start, *inputs)
            report = adjust(state, options, terms=terms, fixed=fixed)
            layer = replace(layer, start=report.scene)
        assert report.status in ("converged", "stalled")
        return layer

    return make


@pytest.mark.parametrize("name", CASES)
def test_gradients_are_those_of_the_implicit_function_theorem(layer_of, draw, name):
    """-H^-1 dg of the cost by definition, with inner constraints on the reduced unknowns where there is a gauge."""
    layer = layer_of(name)
    inputs = tuple(tensor.clone().requires_grad_() for tensor in layer.inputs)
    problem = layer.problem()
    layout, null_space = problem.layout, problem.linearize(layer.start).system.null_space
    by_unknowns, *by_inputs = _second_derivatives(layer, layout, inputs)

    found = _local(layer(*inputs), layer.start, layout)

    derivatives = [-_bordered_inverse(by_unknowns, null_space) @ by_input for by_input in by_inputs]
    assert found.detach().abs().max() < 1e-4
    for _ in range(2):
        some = draw.normal(num_unknowns(layout)) / _size_of_unknowns(layout, layer.start)
        gradients = torch.autograd.grad(found, inputs, some, retain_graph=True, materialize_grads=True)
        for gradient, derivative in zip(gradients, derivatives, strict=True):
            expected = (some @ derivative).view_as(gradient)
            torch.testing.assert_close(gradient, expected, rtol=1e-4, atol=1e-6 * float(expected.abs().max()))


@pytest.mark.parametrize(
    "name",
    [
        "pixels, squared, free",
        "priors",
        "a bar and control points, squared",
        "intrinsics, squared, free",
        "index ratio expected",
    ],
)
def test_they_are_what_adjusting_again_from_the_solution_gives(layer_of, name):
    layer = layer_of(name)
    changes = tuple(torch.zeros_like(tensor).requires_grad_() for tensor in layer.inputs)

    def adjusted(*changes):
        inputs = (x + size * change for x, size, change in zip(layer.inputs, layer.sizes, changes, strict=True))
        state = layer(*inputs)
        return state.views.rotation, state.views.center, state.points

    assert gradcheck(adjusted, changes, eps=0.02, atol=1e-3, rtol=1e-3, fast_mode=True)


@pytest.mark.parametrize("name", [name for name in CASES if "cauchy" in name or "index" in name])
def test_the_result_is_that_of_adjust(layer_of, name):
    layer = layer_of(name)
    state, terms = layer.make(layer.start, *layer.inputs)
    start = changed(state, center=state.views.center + (0.0 if layer.fixed is not None else 0.05))

    found = adjust_differentiably(start, layer.options, terms=terms, fixed=layer.fixed)

    report = adjust(start, layer.options, terms=terms, fixed=layer.fixed)
    for field in ("rotation", "center", "points", "index_ratio", "normal", "offset"):
        torch.testing.assert_close(tensor_of(found, field), tensor_of(report.scene, field), rtol=0.0, atol=1e-12)
    torch.testing.assert_close(found.cameras.focal, report.scene.cameras.focal, rtol=1e-14, atol=0.0)


def test_where_the_search_starts_has_no_gradient(layer_of):
    layer = layer_of("pixels, squared, free")
    start = changed(
        layer.start, **{n: tensor_of(layer.start, n).clone().requires_grad_() for n in ("rotation", "center", "points")}
    )
    pixels = layer.inputs[0].clone().requires_grad_()
    state, terms = layer.make(start, pixels)

    result = adjust_differentiably(state, layer.options, terms=terms)

    started = (start.views.rotation, start.views.center, start.points)
    gradients = torch.autograd.grad(
        result.points.sum() + result.views.center.sum(), (pixels, *started), allow_unused=True
    )
    assert gradients[0].abs().max() > 0.0
    assert gradients[1:] == (None, None, None)


def test_without_anything_that_requires_a_gradient_there_is_none(layer_of):
    layer = layer_of("pixels, squared, free")

    assert not layer(*layer.inputs).points.requires_grad


def test_what_is_fixed_has_no_gradient_and_what_is_not_does(layer_of, draw):
    layer = layer_of("pixels, cauchy, fixed")
    pixels = layer.inputs[0].clone().requires_grad_()

    result = layer(pixels)

    free, *fixed = (
        torch.autograd.grad(value, pixels, retain_graph=True)[0].abs().max()
        for value in (
            result.views.center[1, 0],
            result.views.center[0, 1],
            result.views.center[2, 1],
            result.views.rotation[0, 1, 2],
        )
    )
    assert free > 0.0
    assert fixed == [0.0, 0.0, 0.0]


@pytest.mark.parametrize("loss", ["squared", "cauchy"])
def test_along_the_gauge_nothing_moves(layer_of, draw, loss):
    layer = layer_of(f"pixels, {loss}, free")
    pixels = layer.inputs[0].clone().requires_grad_()
    problem = layer.problem()
    null_space = problem.linearize(layer.start).system.null_space

    reduced = _local(layer(pixels), layer.start, problem.layout)[: problem.layout.size]

    along = torch.stack([torch.autograd.grad(reduced, pixels, n, retain_graph=True)[0].norm() for n in null_space.T])
    across = torch.autograd.grad(reduced, pixels, draw.normal(len(reduced)))[0].norm()
    assert along.max() < 1e-9 * across


def test_a_point_that_all_its_weights_leave_alone_does_not_spoil_the_gradients_of_the_others(plant):
    planted = plant(views=4, points=10, noise=0.5)
    pixels = planted.observations.pixels.clone().requires_grad_()
    weight = (planted.observations.point != 3).double()

    found, expected = (
        torch.autograd.grad(
            adjust_differentiably(changed(planted.truth, observations=seen), SQUARED, terms=[planted.gravity])
            .views.center[:, 2]
            .sum(),
            pixels,
        )[0]
        for w in (weight, weight.clamp(min=1e-6))
        for seen in [replace(planted.observations, pixels=pixels, weight=w)]
    )

    torch.testing.assert_close(found, expected, rtol=1e-3, atol=1e-5 * float(expected.abs().max()))


def test_nor_has_that_point_a_gradient(plant):
    planted = plant(views=4, points=10, noise=0.5)
    pixels = planted.observations.pixels.clone().requires_grad_()
    seen = replace(planted.observations, pixels=pixels, weight=(planted.observations.point != 3).double())

    result = adjust_differentiably(changed(planted.truth, observations=seen), SQUARED, terms=[planted.gravity])

    (gradient,) = torch.autograd.grad(result.points[3].sum(), pixels)
    assert torch.equal(gradient, torch.zeros_like(gradient))


def test_the_terms_of_the_distortion_that_are_fixed_beside_the_radial_ones_have_gradients(plant):
    planted = plant(views=4, points=30, noise=0.2)
    options = replace(SQUARED, refine=("radial",))
    start = adjust(planted.truth, options, terms=[planted.gravity]).scene
    given = start.cameras.distortion
    distortion = given.clone().requires_grad_()

    def centers(distortion):
        state = changed(start, distortion=distortion)
        return adjust_differentiably(state, options, terms=[planted.gravity]).views.center

    direction, step = torch.tensor((0.0, 0.0, 1.0, -2.0, 0.5, 0.0, 0.0, 0.0), dtype=torch.float64), 1e-4
    ahead, behind = (centers(given + sign * step * direction).sum() for sign in (1.0, -1.0))
    (gradient,) = torch.autograd.grad(centers(distortion).sum(), distortion)
    assert float(gradient @ direction) == pytest.approx(float(ahead - behind) / (2.0 * step), rel=1e-3)


def test_a_height_that_is_fixed_beside_a_tilt_has_a_gradient(plant):
    planted = plant(views=4, points=30, noise=0.2)
    options = replace(SQUARED, refine=("plane_tilt",))
    terms = [planted.gravity, CenterPrior(*_positions(planted.truth))]
    offset = torch.zeros(1, dtype=torch.float64, requires_grad=True)

    def depth(offset):
        state = changed(planted.truth, offset=offset)
        return adjust_differentiably(state, options, terms=terms).points[:, 2].sum()

    ahead, behind = (depth(torch.full((1,), step, dtype=torch.float64)) for step in (1e-3, -1e-3))
    (gradient,) = torch.autograd.grad(depth(offset), offset)
    assert float(gradient) == pytest.approx(float(ahead - behind) / 2e-3, rel=1e-3)


def test_a_loss_of_the_result_can_be_learnt_from(plant):
    """The index ratio that puts a point at its known depth is found by Newton steps on the gradient."""
    planted = plant(views=4, points=15)
    height = HeightPrior(torch.tensor([0]), planted.truth.views.center[:1, 2], 0.01 * ONE)
    ratio = torch.tensor(1.31, dtype=torch.float64)

    for _ in range(4):
        ratio.requires_grad_()
        result = adjust_differentiably(
            changed(planted.truth, index_ratio=ratio), SQUARED, terms=[height, planted.gravity]
        )
        off = result.points[4, 2] - planted.truth.points[4, 2]
        ratio = (ratio - off / torch.autograd.grad(off, ratio)[0]).detach()

    assert float(ratio) == pytest.approx(planted.truth.index_ratio, abs=1e-6)


def test_what_cannot_be_adjusted_raises_as_adjust_does(plant):
    planted = plant(views=4, points=10)
    alone = planted.without((planted.observations.point == 3) & (planted.observations.view != 0))

    with pytest.raises(UnadjustableError, match="seen by fewer than two images: point"):
        adjust_differentiably(alone.seen_in(alone.truth))


def test_a_frozen_ratio_raises(plant):
    planted = plant(views=4, points=10)

    with pytest.raises(ValueError, match="jacobian is 'frozen_ratio', but the gradients of a minimum need"):
        adjust_differentiably(planted.truth, replace(SQUARED, jacobian="frozen_ratio"))


def _positions(truth):
    information = torch.eye(3, dtype=torch.float64).expand(len(truth.views.center), 3, 3)
    return torch.arange(len(truth.views.center)), truth.views.center, information


def _second_derivatives(layer: Layer, layout: Layout, inputs: Sequence[Tensor]) -> list[Tensor]:
    """Of the cost by definition at the solution: in the unknowns twice, and in the unknowns and each of the inputs."""
    unknowns = torch.zeros(num_unknowns(layout), dtype=torch.float64, requires_grad=True)
    state, terms = layer.make(layer.start, *inputs)
    options = layer.options
    terms = BundleProblem.create(state, layout, options, terms).terms
    anchor = layer.start
    if "focal" not in layout.intrinsics:
        anchor = replace(anchor, cameras=state.cameras)
    if "index_ratio" not in layout.water:
        anchor = changed(anchor, index_ratio=state.interfaces.index_ratio)
    at = moved(layout, changed(anchor, normal=state.interfaces.normal, offset=state.interfaces.offset), unknowns)
    seen = state.observations
    square = errors_of(at, seen).square().sum(dim=-1)
    cost = (seen.weights * robust(square, options.loss, options.loss_scale)[0]).sum()
    for term in terms:
        cost = cost + options.pixel_sigma**2 * term.residuals(at, layout).value.square().sum()
    (gradient,) = torch.autograd.grad(0.5 * cost, unknowns, create_graph=True)
    if layout.fixed is not None:
        free = torch.ones_like(gradient)
        free[: 6 * layout.num_views] = (~layout.fixed.flatten()).double()
        gradient = gradient * free
    unit = torch.eye(len(gradient), dtype=torch.float64)
    inputs = (unknowns, *inputs)
    every = torch.autograd.grad(gradient, inputs, unit, is_grads_batched=True, allow_unused=True)
    return [
        unit.new_zeros(len(unit), x.numel()) if by is None else by.reshape(len(unit), -1)
        for x, by in zip(inputs, every, strict=True)
    ]


def _bordered_inverse(hessian: Tensor, null_space: Tensor | None) -> Tensor:
    """Of [H C; C^T 0]; zero for what is fixed."""
    alive = hessian.diagonal().abs().nonzero()[:, 0]
    border = torch.zeros(len(hessian), 0 if null_space is None else null_space.shape[1], dtype=torch.float64)
    if null_space is not None:
        border[: len(null_space)] = null_space
    unit = hessian.diagonal()[alive].abs().sqrt()
    scaled = hessian[alive][:, alive] / unit[:, None] / unit
    border = torch.linalg.qr(border[alive] / unit[:, None]).Q
    count = border.shape[1]
    upper = torch.cat((scaled, border), dim=1)
    lower = torch.cat((border.T, torch.zeros(count, count, dtype=torch.float64)), dim=1)
    inverse = torch.linalg.inv(torch.cat((upper, lower)))[: len(alive), : len(alive)] / unit[:, None] / unit
    whole = torch.zeros_like(hessian)
    whole[alive[:, None], alive] = inverse
    return whole


def _local(state: Scene, at: Scene, layout: Layout) -> Tensor:
    """Where `state` is, near `at`, in the unknowns of the layout (of intrinsics and water: focal and index_ratio)."""
    turn = state.views.rotation @ at.views.rotation.mT
    skew = 0.5 * (turn - turn.mT)
    pose = torch.cat(
        (torch.stack((skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]), dim=-1), state.views.center - at.views.center),
        dim=-1,
    )
    shared = []
    if layout.intrinsics:
        shared.append((state.cameras.focal[0, :1] / at.cameras.focal[0, :1]).log())
    if layout.water:
        shared.append(state.interfaces.index_ratio - at.interfaces.index_ratio)
    points = state.points - at.points
    reduced = layout.reduced if layout.reduced is not None else torch.zeros(len(points), dtype=torch.bool)
    return torch.cat((pose.flatten(), *shared, points[reduced].flatten(), points[~reduced].flatten()))


def _size_of_unknowns(layout: Layout, state: Scene) -> Tensor:
    """As large as what they do in an image: radians and ratios to one, lengths to the height of the cameras."""
    size = torch.full((num_unknowns(layout),), float(state.views.center[:, 2].mean()), dtype=torch.float64)
    poses = 6 * layout.num_views
    size[:poses] = (size.new_tensor((1.0, 1.0, 1.0, *3 * (float(size[-1]),)))).repeat(layout.num_views)
    size[poses : layout.first_point] = 1.0
    return size
