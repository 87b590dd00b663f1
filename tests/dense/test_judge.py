"""Which patches are believed, and how far: by planes that are known, and by noise that is added."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from tests.dense.rendered_scenes import FOCAL, Board, cameras_around, marble, render
from torchrefrac.camera import Intrinsics, RefractiveCamera
from torchrefrac.dense.judge import fewest_others, plane_through
from torchrefrac.dense.options import DenseOptions
from torchrefrac.dense.patches import Planes
from torchrefrac.dense.refine import refine
from torchrefrac.refraction import FlatInterface

OPTIONS = DenseOptions()
AS_THEY_ARE = DenseOptions(iterations=0)  # guesses are judged without being adjusted
FLAT, SLOPE = Board((0.0, 0.0, -40.0)), Board((0.0, 0.0, -40.0), (0.9, -0.4, 1.0))
NEAR, FAR = 20.0, 90.0


@pytest.fixture(scope="module")
def pond():
    """Five photographs of a flat bottom."""
    return render([FLAT], cameras_around(5, 30.0, -30.0, 1.33), marble(), 1.33)


@pytest.fixture(scope="module")
def slope():
    """Four photographs of a slope."""
    return render([SLOPE], cameras_around(4, 30.0, -30.0, 1.33), marble(), 1.33)


def _lattice(step: int = 8) -> Tensor:
    """Middles of pixels (N, 2) of the reference, well inside it."""
    y, x = torch.meshgrid(torch.arange(12.5, 110.0, step), torch.arange(12.5, 150.0, step), indexing="ij")
    return torch.stack((x.flatten(), y.flatten()), dim=-1).double()


def _truth(rendered, pixels: Tensor) -> Planes:
    points, normals = rendered.at(pixels)
    return Planes(points, normals)


def _judged(rendered, options: DenseOptions, step: int = 8, near: float = NEAR, far: float = FAR):
    """The true planes, judged as they are."""
    pixels = _lattice(step)
    return refine(rendered.scope(near, far, options), pixels, _truth(rendered, pixels), options)


def test_three_points_span_the_plane_through_them(draw):
    corners = draw.normal(50, 3, 3)

    point, normal = plane_through(corners)

    torch.testing.assert_close(normal.norm(dim=1), torch.ones(50).double())
    away = ((corners - point[:, None]) * normal[:, None]).sum(dim=-1)
    torch.testing.assert_close(away, torch.zeros(50, 3).double(), rtol=0.0, atol=1e-12)


@pytest.mark.parametrize(
    ("images", "min_views", "fewest"), [(5, 3, 2), (5, 2, 1), (5, 5, 4), (3, 5, 2), (2, 3, 1), (2, 2, 1)]
)
def test_fewer_images_must_agree_where_there_are_fewer(images, min_views, fewest):
    rendered = render([FLAT], cameras_around(images, 30.0, -30.0, 1.33), marble(), 1.33)

    assert fewest_others(rendered.scope(NEAR, FAR, OPTIONS), DenseOptions(min_views=min_views)) == fewest


def test_a_true_plane_stays_where_it_is_and_faces_the_camera(slope):
    patches, kept = _judged(slope, AS_THEY_ARE)

    points, normals = slope.at(patches.pixels)
    assert len(kept) > 0.8 * len(_lattice())
    torch.testing.assert_close(patches.points, points, rtol=0.0, atol=1e-9)
    torch.testing.assert_close(patches.normals, normals / normals.norm(dim=-1, keepdim=True), rtol=0.0, atol=1e-9)
    assert patches.score.median() > 0.99


def test_images_are_told_by_their_numbers_in_the_reconstruction(pond):
    ids = torch.tensor([7, 3, 12, 9, 4])
    scope, pixels = replace(pond.scope(NEAR, FAR, OPTIONS), ids=ids), _lattice(16)

    patches, _ = refine(scope, pixels, _truth(pond, pixels), AS_THEY_ARE)

    assert patches.reference.unique().tolist() == [7]
    assert patches.others.unique().tolist() == [3, 4, 9, 12]
    assert torch.equal(patches.views, 1 + patches.visible.sum(dim=1))


@pytest.mark.parametrize("index_ratio", [1.0, 1.33])
def test_straight_ahead_a_pixel_reaches_as_far_as_the_apparent_distance_over_the_focal_length(index_ratio):
    """Looking straight down: the height above the water, and the depth divided by the index."""
    rendered = render([FLAT], _looking_down((0.0, 0.0, 30.0), (9.0, 0.0, 30.0)), marble(), index_ratio)
    rendered = replace(rendered, cameras=replace(rendered.cameras, interface=FlatInterface(index_ratio)))
    pixels = torch.tensor([(80.5, 60.5)], dtype=torch.float64)

    patches, _ = refine(rendered.scope(NEAR, FAR, OPTIONS), pixels, _truth(rendered, pixels), AS_THEY_ARE)

    expected = torch.tensor([(30.0 + 40.0 / index_ratio) / FOCAL], dtype=torch.float64)
    torch.testing.assert_close(patches.footprint, expected, rtol=2e-3, atol=0.0)


def test_what_is_nearer_or_farther_than_it_may_be_is_refused(pond):
    distance = _along_rays(pond, _judged(pond, AS_THEY_ARE)[0])
    near, far = distance.quantile(0.3).item(), distance.quantile(0.7).item()

    patches, _ = _judged(pond, AS_THEY_ARE, near=near, far=far)

    expected = distance[(distance > near) & (distance < far)]
    torch.testing.assert_close(_along_rays(pond, patches), expected, rtol=0.0, atol=1e-9)


def _along_rays(rendered, patches) -> Tensor:
    origins, _, valid = rendered.cameras[0].cast_rays(patches.pixels)
    assert valid.all()
    return (patches.points - origins).norm(dim=-1)


def test_patches_more_slanted_than_they_may_be_are_refused(slope):
    pixels = _lattice()
    _, direction, _ = slope.cameras[0].cast_rays(pixels)
    _, normals = slope.at(pixels)
    slant = torch.rad2deg(torch.acos((direction * normals).sum(dim=-1).abs() / normals.norm(dim=-1)))
    most = float(slant.median()) + 1e-6

    _, all_kept = _judged(slope, AS_THEY_ARE)
    _, kept = _judged(slope, replace(AS_THEY_ARE, max_slant=most))

    assert set(kept.tolist()) == set(all_kept[slant[all_kept] < most].tolist())
    assert 0 < len(kept) < len(all_kept)


def test_images_that_disagree_do_not_count(pond, draw):
    """Two of the four others show something else."""
    images = pond.images.clone()
    images[[1, 3]] = 128.0 + 40.0 * draw.normal(2, *images.shape[1:]).float()
    fooled = replace(pond, images=images)

    (with_three, _), (with_four, _) = (_judged(fooled, replace(AS_THEY_ARE, min_views=n)) for n in (3, 4))

    assert len(with_three) > 0.7 * len(_lattice())
    assert not with_three.visible[(with_three.others == 1) | (with_three.others == 3)].any()
    assert with_three.score.median() > 0.99
    assert len(with_four) == 0


def test_a_lower_score_than_asked_for_is_refused(pond, draw):
    noisy = replace(pond, images=pond.images + 12.0 * draw.normal(*pond.images.shape).float())

    patches, _ = _judged(noisy, replace(AS_THEY_ARE, min_score=0.5))
    stricter, _ = _judged(noisy, replace(AS_THEY_ARE, min_score=float(patches.score.median())))

    assert patches.score.min() > 0.5
    assert stricter.score.min() > patches.score.median()
    assert len(stricter) < len(patches)


def test_patches_that_are_too_uncertain_are_refused(pond, draw):
    noisy = replace(pond, images=pond.images + 10.0 * draw.normal(*pond.images.shape).float())
    loose = replace(AS_THEY_ARE, min_score=0.5, max_sigma=10.0)
    patches, all_kept = _judged(noisy, loose)
    shift = patches.sigma * _motion(pond, patches)
    most = float(shift.median())

    _, kept = _judged(noisy, replace(loose, max_sigma=most))

    surely, perhaps = all_kept[shift < 0.99 * most].tolist(), all_kept[shift < 1.01 * most].tolist()
    assert set(surely) <= set(kept.tolist()) <= set(perhaps)


def _motion(rendered, patches) -> Tensor:
    """Pixels by which patches move at most in the images that agree, for a step of one along their rays."""
    _, direction, _ = rendered.cameras[0].cast_rays(patches.pixels)
    before, after = (rendered.cameras[:, None].project(patches.points + s * direction)[0] for s in (-1e-4, 1e-4))
    motion = ((after - before).norm(dim=-1) / 2e-4).T.gather(1, patches.others)
    return torch.where(patches.visible, motion, 0.0).amax(dim=1)


def _looking_down(*centers) -> RefractiveCamera:
    down = torch.diag(torch.tensor((1.0, -1.0, -1.0), dtype=torch.float64)).expand(len(centers), 3, 3)
    lens = Intrinsics.create(160, 120, FOCAL)
    return RefractiveCamera(lens, down, torch.tensor(centers, dtype=torch.float64), FlatInterface(1.0))


@pytest.mark.parametrize(("along", "believed"), [(0, 0.0), (1, 1.0)])
def test_stripes_say_something_of_the_distance_only_where_they_cross_the_base_line(along, believed):
    """Stripes that vary along y alone, and two cameras that stand apart along x or along y."""
    apart = [(0.0, 0.0, 30.0), (0.0, 0.0, 30.0)]
    apart[1] = (12.0, 0.0, 30.0) if along == 0 else (0.0, 12.0, 30.0)
    rendered = render([FLAT], _looking_down(*apart), lambda p: 128.0 + 50.0 * _waves(p[..., 1]), 1.0)
    pixels = _lattice()
    pixels = pixels[rendered.cameras[1].project(rendered.at(pixels)[0], inside_image=True)[1]]

    patches, _ = refine(rendered.scope(NEAR, FAR, OPTIONS), pixels, _truth(rendered, pixels), AS_THEY_ARE)

    assert len(patches) == pytest.approx(believed * len(pixels), abs=0.2 * len(pixels) * believed)


def test_a_mere_ramp_says_nothing_of_the_distance():
    rendered = render([FLAT], _looking_down((0.0, 0.0, 30.0), (9.0, 0.0, 30.0)), lambda p: 128.0 + 3.0 * p[..., 0], 1.0)
    pixels = _lattice()

    patches, _ = refine(rendered.scope(NEAR, FAR, OPTIONS), pixels, _truth(rendered, pixels), AS_THEY_ARE)

    assert len(patches) == 0


def _waves(y: np.ndarray) -> np.ndarray:
    length = np.array((3.1, 4.7, 7.9))
    return 0.55 * np.sin(2.0 * np.pi * y[..., None] / length + length).sum(axis=-1)


@pytest.mark.parametrize("count", [2, 5])
@pytest.mark.parametrize("interpolation", ["bilinear", "bicubic"])
def test_sigma_is_the_scatter_that_noise_in_the_images_makes(draw, count, interpolation):
    """Within a factor of 1.35."""
    error, sigma = _trials(draw, count, interpolation, contrast=25.0, noise=3.0)

    found = error.isfinite().all(dim=0)
    assert found.double().mean() > 0.8
    ratio = error[:, found].std(dim=0) / sigma[:, found].square().mean(dim=0).sqrt()
    assert 1.0 / 1.35 < ratio.square().mean().sqrt() < 1.35
    assert ((error / sigma)[:, found].abs() < 4.0).double().mean() > 0.97


@pytest.mark.parametrize("count", [2, 5])
def test_sigma_is_no_less_than_what_interpolation_leaves_in_clean_images(draw, count):
    error, sigma = _trials(draw, count, "bicubic", contrast=45.0, noise=0.5)

    off = (error / sigma)[error.isfinite()]
    assert 0.25 < off.square().mean().sqrt() < 1.0
    assert (off.abs() < 3.0).double().mean() > 0.99


def _trials(draw, count, interpolation, contrast, noise):
    """Of patches refined from the truth again and again, under fresh noise: how far they end from it along their rays,
    and their sigma; NaN where one was not believed. Both (12, N)."""
    options, pixels = DenseOptions(interpolation=interpolation), _lattice(16)
    rendered = render([FLAT], cameras_around(count, 30.0, -30.0, 1.33), marble(contrast), 1.33)
    _, direction, _ = rendered.cameras[0].cast_rays(pixels)
    planes = _truth(rendered, pixels)
    error, sigma = torch.full((2, 12, len(pixels)), math.nan, dtype=torch.float64)
    for trial in range(12):
        noisy = replace(rendered, images=rendered.images + noise * draw.normal(*rendered.images.shape).float())
        patches, kept = refine(noisy.scope(NEAR, FAR, options), pixels, planes, options)
        error[trial, kept] = ((patches.points - planes.points[kept]) * direction[kept]).sum(dim=-1)
        sigma[trial, kept] = patches.sigma
    return error, sigma


def test_sigma_grows_with_the_noise(draw, pond):
    grey = draw.normal(*pond.images.shape).float()

    sigma = [
        float(_judged(replace(pond, images=pond.images + noise * grey), AS_THEY_ARE)[0].sigma.median())
        for noise in (0.0, 2.0, 8.0)
    ]

    assert sigma[0] < sigma[1]
    assert sigma[2] > 1.5 * sigma[1]
