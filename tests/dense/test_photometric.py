"""Costs of patches: against ZNCC by NumPy and SciPy, automatic derivatives and finite differences."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.ndimage import map_coordinates
from torch import Tensor

from tests.dense.rendered_scenes import Board, cameras_around, marble, render
from tests.made_device import on_every_device
from torchrefrac.camera import Intrinsics, RefractiveCamera
from torchrefrac.dense.atlas import Atlas
from torchrefrac.dense.photometric import WORST, Agreement, Comparison, patch_costs, unit_windows
from torchrefrac.dense.rays import PixelRays
from torchrefrac.dense.window import Window
from torchrefrac.geometry import Plane, so3_exp
from torchrefrac.numerics import on_device
from torchrefrac.optim.batched import Quadratic
from torchrefrac.refraction import FlatInterface

COUNT, VIEWS, TAU = 12, 3, 0.4
WINDOW = Window()
REFERENCE = torch.zeros(COUNT, dtype=torch.long)
OTHERS = torch.arange(1, 1 + VIEWS).expand(COUNT, VIEWS)
BOARDS = {
    "a flat bottom": Board((0.0, 0.0, -40.0)),
    "a steep slope": Board((0.0, 0.0, -40.0), (0.8, -0.5, 1.0)),
    "land": Board((0.0, 0.0, 6.0), (0.1, 0.2, 1.0)),
    "a shore": Board((0.0, 0.0, 0.0), (0.5, 0.1, 1.0)),
}
for_every_board = pytest.mark.parametrize("name", BOARDS)


@pytest.fixture(scope="module")
def photographs():
    """By the name of the board: cameras (4) and float64 images (4, h, w)."""

    def taken(board):
        cameras = cameras_around(1 + VIEWS, 30.0, board.point[2], 1.33)
        return cameras, render([board], cameras, marble(), 1.33).images.double()

    return {name: taken(board) for name, board in BOARDS.items()}


def _patches(draw, cameras: RefractiveCamera, board: Board) -> tuple[Tensor, Tensor]:
    """Pixels (COUNT, 2) in the middle of the reference, and states (COUNT, 3) that are a little off the board."""
    pixels = torch.stack((draw.uniform(50.0, 110.0, COUNT), draw.uniform(40.0, 80.0, COUNT)), dim=-1)
    rays = PixelRays.cast(cameras[0], pixels[:, None] + WINDOW.corners)
    point, normal = (torch.tensor(v, dtype=torch.float64) for v in (board.point, board.normal))
    states = rays.meet(point, normal) @ torch.linalg.inv(WINDOW.basis).T
    return pixels, states + draw.uniform(-0.3, 0.3, COUNT, 3)


def _comparison(cameras: RefractiveCamera, atlas: Atlas, pixels: Tensor) -> Comparison:
    level = torch.zeros_like(REFERENCE)
    return Comparison(
        atlas=atlas,
        window=WINDOW,
        cameras=cameras,
        rays=PixelRays.cast(cameras[0], pixels[:, None] + WINDOW.corners),
        reference=unit_windows(atlas, REFERENCE, level, pixels, WINDOW)[0],
        image=OTHERS,
        level=torch.zeros_like(OTHERS),
        present=torch.ones_like(OTHERS, dtype=torch.bool),
        tau=TAU,
    )


def _agreement(comparison: Comparison, states: Tensor) -> Agreement:
    return comparison.agreement(comparison.project(states))


def _model(comparison: Comparison, states: Tensor) -> Quadratic:
    return comparison.model(_agreement(comparison, states))


def _zncc_by_numpy(cameras, images, pixels, state):
    """Of one patch in every other image (VIEWS), by the affine map between three projected points."""
    corners = pixels.numpy() + WINDOW.corners.numpy()
    distances = state[0] + WINDOW.corners @ state[1:] / WINDOW.radius
    points = PixelRays.cast(cameras[0], torch.as_tensor(corners)).at(distances)
    steps = np.arange(WINDOW.size) - WINDOW.size // 2
    window = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2) + pixels.numpy()

    def grey(image, at):
        return map_coordinates(images[image].numpy(), (at[:, 1] - 0.5, at[:, 0] - 0.5), order=1)

    scores = []
    for other in range(1, 1 + VIEWS):
        seen = cameras[other].project(points)[0].numpy()
        affine = np.linalg.solve(np.column_stack((corners, np.ones(3))), seen)
        f, g = grey(0, window), grey(other, np.column_stack((window, np.ones(len(window)))) @ affine)
        scores.append(np.corrcoef(f, g)[0, 1])
    return scores


@for_every_board
def test_agreement_is_the_zncc_of_the_windows_as_numpy_samples_them(draw, photographs, name):
    cameras, images = photographs[name]
    pixels, states = _patches(draw, cameras, BOARDS[name])

    agreement = _agreement(_comparison(cameras, Atlas.build(list(images), 1), pixels), states)

    expected = [_zncc_by_numpy(cameras, images, pixels[i], states[i]) for i in range(COUNT)]
    assert agreement.usable.all()
    torch.testing.assert_close(agreement.zncc, torch.tensor(expected, dtype=torch.float64), rtol=0.0, atol=1e-10)
    assert agreement.zncc.amax() > 0.9


@on_every_device
def test_costs_and_their_models_are_those_of_the_cpu_on_other_devices(draw, photographs, device):
    cameras, images = photographs["a steep slope"]
    pixels, states = _patches(draw, cameras, BOARDS["a steep slope"])
    here = _comparison(cameras, Atlas.build(list(images), 1), pixels)

    there = _model(on_device(here, device), states.to(device))

    for one, other in zip(there, _model(here, states), strict=True):
        assert one.device.type == device
        torch.testing.assert_close(one.cpu(), other, rtol=1e-10, atol=1e-10)


@for_every_board
def test_cost_and_gradient_are_those_that_automatic_differentiation_finds(draw, photographs, name):
    cameras, images = photographs[name]
    pixels, states = _patches(draw, cameras, BOARDS[name])
    atlas = Atlas.build(list(images), 1)
    states = states.requires_grad_()

    model = _model(_comparison(cameras, atlas, pixels), states.detach())
    cost = patch_costs(cameras, atlas, REFERENCE, pixels, states, OTHERS, WINDOW, TAU)

    (gradient,) = torch.autograd.grad(cost.sum(), states)
    torch.testing.assert_close(model.cost, cost.detach(), rtol=1e-10, atol=1e-12)
    torch.testing.assert_close(model.gradient, gradient, rtol=1e-9, atol=1e-10)
    assert gradient.abs().amax(dim=1).min() > 1e-3


@for_every_board
def test_gradients_are_the_differences_of_the_costs(draw, photographs, name):
    """Between samples of a surface without kinks."""
    cameras, images = photographs[name]
    pixels, states = _patches(draw, cameras, BOARDS[name])
    comparison = _comparison(cameras, Atlas.build(list(images), 1, mode="bicubic"), pixels)

    gradient = _model(comparison, states).gradient

    for axis, step in enumerate(1e-5 * torch.eye(3, dtype=torch.float64)):
        differences = (_model(comparison, states + step).cost - _model(comparison, states - step).cost) / 2e-5
        torch.testing.assert_close(gradient[:, axis], differences, rtol=1e-6, atol=1e-7)


@for_every_board
def test_the_hessian_is_the_square_of_the_jacobian_of_the_unit_windows(draw, photographs, name):
    """Each image's, and with the slope of the robust loss as its weight their sum."""
    cameras, images = photographs[name]
    pixels, states = _patches(draw, cameras, BOARDS[name])
    atlas = Atlas.build(list(images), 1)
    comparison = _comparison(cameras, atlas, pixels)

    def unit(states):
        points = comparison.corners(states)
        seen = WINDOW.weights @ cameras[OTHERS][..., None].project(points[:, None])[0]
        values = torch.stack([atlas.sample(OTHERS[:, v], REFERENCE, seen[:, v]) for v in range(VIEWS)], dim=1)
        values = values - values.mean(dim=-1, keepdim=True)
        return (values / values.norm(dim=-1, keepdim=True)).sum(dim=0)

    jacobian = torch.autograd.functional.jacobian(unit, states).movedim(2, 0)
    agreement, model = _agreement(comparison, states), _model(comparison, states)

    expected = jacobian.mT @ jacobian
    torch.testing.assert_close(agreement.hessian, expected, rtol=1e-8, atol=1e-10)
    weight = (1.0 + (1.0 - agreement.zncc) / TAU) ** -2
    torch.testing.assert_close(model.hessian, (weight[..., None, None] * expected).sum(dim=1), rtol=1e-8, atol=1e-10)
    residual = jacobian.mT @ -comparison.reference[:, None, :, None]
    torch.testing.assert_close(agreement.gradient, residual[..., 0], rtol=1e-8, atol=1e-10)


@for_every_board
def test_motion_is_how_far_the_patch_moves_in_an_image_when_its_distance_grows(draw, photographs, name):
    cameras, images = photographs[name]
    pixels, states = _patches(draw, cameras, BOARDS[name])
    comparison = _comparison(cameras, Atlas.build(list(images), 1), pixels)
    step = torch.tensor((1e-5, 0.0, 0.0), dtype=torch.float64)

    motion = _agreement(comparison, states).motion

    before, after = (
        cameras[OTHERS][..., None].project(comparison.corners(at)[:, None])[0].mean(dim=-2)
        for at in (states - step, states + step)
    )
    torch.testing.assert_close(motion, (after - before).norm(dim=-1) / 2e-5, rtol=1e-6, atol=1e-7)


def _small_pond(draw):
    """Three small cameras through a tilted surface, float64 images, and two patches: one wet, one on land."""
    around = cameras_around(3, 30.0, -40.0, 1.33)
    cameras = replace(around, intrinsics=Intrinsics.create(40, 36, 40.0))
    y, x = torch.meshgrid(torch.arange(36.0).double(), torch.arange(40.0).double(), indexing="ij")
    phase = draw.uniform(0.0, 6.0, 3, 2)
    images = [100.0 + 40.0 * (0.5 * x + 0.2 * y + p).sin() + 30.0 * (0.4 * y - 0.1 * x + q).sin() for p, q in phase]
    pixels = torch.tensor([(19.3, 17.8), (22.1, 20.4)], dtype=torch.float64)
    states = torch.tensor([(42.0, 1.5, -0.7), (-6.0, 0.8, 1.1)], dtype=torch.float64)
    return cameras, images, pixels, states


CHANGES = {
    "rotation": (3, 3),
    "centre": (3, 3),
    "tilt": (2,),
    "height": (),
    "index ratio": (),
    "focal length": (2,),
    "principal point": (2,),
    "distortion": (5,),
    "pixels": (2, 2),
    "states": (2, 3),
}


@pytest.mark.parametrize("changed", CHANGES)
def test_costs_have_the_right_derivatives_in_all_that_makes_them(draw, changed):
    cameras, images, pixels, states = _small_pond(draw)
    atlas = Atlas.build(images, 1, mode="bicubic")
    reference, others = torch.zeros(2, dtype=torch.long), torch.tensor([(1, 2), (2, 1)])
    none = {name: torch.zeros(shape, dtype=torch.float64) for name, shape in CHANGES.items()}
    water = Plane((0.03, -0.05, 1.0), 0.4)

    def costs(change):
        by = none | {changed: change}
        lens = cameras.intrinsics
        moved = RefractiveCamera(
            replace(
                lens,
                focal=lens.focal + by["focal length"],
                principal_point=lens.principal_point + by["principal point"],
                distortion=lens.distortion + by["distortion"],
            ),
            so3_exp(by["rotation"]) @ cameras.cam_from_world_rotation,
            cameras.center_in_world + by["centre"],
            FlatInterface(1.33 + by["index ratio"], plane=water.moved(by["tilt"], by["height"])),
        )
        return patch_costs(moved, atlas, reference, pixels + by["pixels"], states + by["states"], others)

    assert (costs(none[changed]) < 2.0 * WORST / (1.0 + WORST / 0.3) - 1e-3).all()
    assert torch.autograd.gradcheck(costs, none[changed].requires_grad_(), atol=1e-6)


def test_costs_have_the_right_derivatives_in_the_images(draw):
    cameras, images, pixels, states = _small_pond(draw)
    reference, others = torch.zeros(2, dtype=torch.long), torch.tensor([(1, 2), (2, 1)])

    def costs(*images):
        return patch_costs(cameras, images, reference, pixels, states, others)

    assert torch.autograd.gradcheck(costs, [image.requires_grad_() for image in images], fast_mode=True)


def test_gain_and_offset_of_an_image_change_nothing(draw, photographs):
    cameras, images = photographs["a flat bottom"]
    pixels, states = _patches(draw, cameras, BOARDS["a flat bottom"])
    gain, offset = torch.tensor([0.5, 1.7, 3.0, 0.2]).double(), torch.tensor([50.0, -20.0, 7.0, 100.0]).double()
    other = gain[:, None, None] * images + offset[:, None, None]

    before, after = (_model(_comparison(cameras, Atlas.build(list(i), 1), pixels), states) for i in (images, other))
    costs = [patch_costs(cameras, list(i), REFERENCE, pixels, states, OTHERS) for i in (images, other)]

    for first, second in (*zip(before, after, strict=True), costs):
        torch.testing.assert_close(first, second, rtol=1e-9, atol=1e-10)


def _unseeing(photographs, how):
    """The same with a second other image that sees nothing of the patches."""
    cameras, images = photographs[0], photographs[1].clone()
    rotation, center = cameras.cam_from_world_rotation.clone(), cameras.center_in_world.clone()
    if how == "looks elsewhere":
        center[2, 0] += 500.0
    elif how == "looks up":
        rotation[2] = torch.diag(torch.tensor((1.0, -1.0, -1.0)).double()) @ rotation[2]
    else:
        images[2] = 130.3
    return replace(cameras, cam_from_world_rotation=rotation, center_in_world=center), images


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("how", ["looks elsewhere", "looks up", "has no texture"])
def test_an_image_that_does_not_see_a_patch_costs_a_constant(draw, photographs, how, dtype):
    cameras, images = _unseeing(photographs["a flat bottom"], how)
    pixels, states = _patches(draw, cameras, BOARDS["a flat bottom"])
    atlas = Atlas.build(list(images.to(dtype)), 1)
    seeing = OTHERS[:, [0, 2]]
    states = states.requires_grad_()

    costs = patch_costs(cameras, atlas, REFERENCE, pixels, states, OTHERS, tau=TAU)
    without = patch_costs(cameras, atlas, REFERENCE, pixels, states, seeing, tau=TAU)
    comparison = _comparison(cameras, atlas, pixels)
    model = _model(comparison, states.detach())

    constant = WORST / (1.0 + WORST / TAU)
    slack = 1e-12 if dtype == torch.float64 else 1e-5
    torch.testing.assert_close(costs, without + constant, rtol=0.0, atol=slack)
    torch.testing.assert_close(model.cost, costs.detach().double(), rtol=0.0, atol=10.0 * slack)
    first, second = (torch.autograd.grad(cost.sum(), states)[0] for cost in (costs, without))
    torch.testing.assert_close(first, second, rtol=0.0, atol=slack)
    assert _agreement(comparison, states.detach()).usable.tolist() == [[True, False, True]] * COUNT


def test_an_image_that_is_not_to_be_looked_at_costs_nothing(draw, photographs):
    cameras, images = photographs["a flat bottom"]
    pixels, states = _patches(draw, cameras, BOARDS["a flat bottom"])
    atlas = Atlas.build(list(images), 1)
    comparison = _comparison(cameras, atlas, pixels)
    present = draw.uniform(0.0, 1.0, COUNT, VIEWS) > 0.4

    model = _model(comparison._replace(present=present), states)

    each = [patch_costs(cameras, atlas, REFERENCE, pixels, states, OTHERS[:, [v]], tau=TAU) for v in range(VIEWS)]
    expected = torch.where(present, torch.stack(each, dim=1), 0.0).sum(dim=1)
    torch.testing.assert_close(model.cost, expected, rtol=1e-10, atol=1e-12)


def test_some_of_the_patches_are_compared_as_they_are_among_all(draw, photographs):
    cameras, images = photographs["a shore"]
    pixels, states = _patches(draw, cameras, BOARDS["a shore"])
    comparison = _comparison(cameras, Atlas.build(list(images), 1), pixels)
    rows = torch.tensor([7, 2, 9])

    fewer = {name: getattr(comparison, name)[rows] for name in ("rays", "reference", "image", "level", "present")}
    some, whole = _model(comparison._replace(**fewer), states[rows]), _model(comparison, states)

    for part, of in zip(some, whole, strict=True):
        torch.testing.assert_close(part, of[rows], rtol=1e-12, atol=1e-12)


def test_a_sheet_in_single_precision_gives_the_same_zncc(draw, photographs):
    cameras, images = photographs["a flat bottom"]
    pixels, states = _patches(draw, cameras, BOARDS["a flat bottom"])

    single, double = (
        _agreement(_comparison(cameras, Atlas.build(list(i), 1), pixels), states) for i in (images.float(), images)
    )

    torch.testing.assert_close(single.zncc.double(), double.zncc, rtol=0.0, atol=2e-5)
    torch.testing.assert_close(single.gradient.double(), double.gradient, rtol=1e-3, atol=1e-4)


def test_every_image_is_compared_in_the_copy_that_shows_the_patch_as_large_as_the_reference_does():
    """Without refraction, looking straight down, an image's scale is the quotient of the heights over the bottom."""
    height = [40.0, 30.0, 18.0, 8.0, 80.0, 101.0]
    down = torch.diag(torch.tensor((1.0, -1.0, -1.0), dtype=torch.float64)).expand(6, 3, 3)
    center = torch.tensor([(0.0, 0.0, h) for h in height], dtype=torch.float64)
    cameras = RefractiveCamera(Intrinsics.create(160, 120, 150.0), down, center, FlatInterface(1.0))
    atlas = Atlas.build([torch.zeros(120, 160)] * 6, 3)
    pixels, others = torch.tensor([(80.0, 60.0)], dtype=torch.float64), torch.arange(1, 6)[None]
    comparison = Comparison(
        atlas=atlas,
        window=WINDOW,
        cameras=cameras,
        rays=PixelRays.cast(cameras[0], pixels[:, None] + WINDOW.corners),
        reference=torch.zeros(1, WINDOW.size**2),
        image=others,
        level=torch.zeros_like(others),
        present=torch.ones_like(others, dtype=torch.bool),
        tau=TAU,
    )
    bottom = comparison.rays.meet(torch.zeros(3).double(), torch.tensor((0.0, 0.0, 1.0)).double())
    states = bottom @ torch.linalg.inv(WINDOW.basis).T

    seen = comparison.project(states)
    fitting = comparison.at_matching_levels(seen, torch.tensor([True]), min_scale=0.4)
    old = fitting.at_matching_levels(comparison.project(3.0 * states), torch.tensor([False]), min_scale=0.4)

    assert fitting.level.tolist() == [[0, 1, 2, 0, 0]]  # log2 of 1.33, 2.22, 5; larger than the reference's: the first
    assert fitting.present.tolist() == [[True, True, True, True, False]]
    assert torch.equal(old.level, fitting.level)
    assert torch.equal(old.present, fitting.present)


def test_a_window_is_sampled_with_mean_zero_and_length_one_and_none_across_the_border(photographs):
    _, images = photographs["a flat bottom"]
    atlas = Atlas.build(list(images), 1)
    pixels = torch.tensor([(40.5, 30.5), (3.5, 60.0), (3.51, 60.0), (156.2, 60.0), (156.6, 60.0)], dtype=torch.float64)
    here = torch.zeros(5, dtype=torch.long)

    unit, contrast = unit_windows(atlas, here + 1, here, pixels, WINDOW)

    inside = [True, False, True, True, False]
    seen = images[1, 27:34, 37:44].flatten()
    torch.testing.assert_close(unit[0], (seen - seen.mean()) / (seen - seen.mean()).norm(), rtol=0.0, atol=1e-12)
    torch.testing.assert_close(contrast[0], seen.std(correction=0), rtol=1e-12, atol=0.0)
    torch.testing.assert_close(unit.norm(dim=1), torch.tensor(inside).double(), rtol=0.0, atol=1e-12)
    torch.testing.assert_close(unit.sum(dim=1), torch.zeros(5).double(), rtol=0.0, atol=1e-12)
    assert (contrast > 0.0).tolist() == inside
