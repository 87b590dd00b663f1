"""The dense reconstruction as a whole, on rendered photographs of surfaces under water."""

import re
from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.dense.rendered_captures import photographed_scene, sparse_scene, write_capture, write_mask
from tests.dense.rendered_scenes import Board, cameras_around, marble, render
from torchrefrac.dense import DenseError, DenseOptions, densify, depth_maps
from torchrefrac.scene import CaptureError, Interfaces

FOOTPRINT = 0.55  # roughly, of all cameras
SLOPE = Board((0.0, 0.0, -40.0), (0.25, -0.1, 1.0))
OPTIONS = {method: DenseOptions(method=method) for method in ("patch", "depthmap")}
methods = pytest.mark.parametrize("method", list(OPTIONS))


def _photographs(count=3, texture=None, board=SLOPE):
    return render([board], cameras_around(count, 30.0, -30.0, 1.33), texture or marble(), 1.33)


@pytest.fixture(scope="module")
def slope():
    """Three photographs of a slope under water."""
    return _photographs()


@pytest.fixture(scope="module", params=list(OPTIONS))
def finished(request, slope, tmp_path_factory):
    """The slope's capture, sparse scene, options and dense reconstruction."""
    capture = write_capture(slope, tmp_path_factory.mktemp("slope"))
    scene, options = sparse_scene(slope), OPTIONS[request.param]
    return capture, scene, options, densify(replace(scene, capture=capture), options)


def _heights(points):
    """Signed distances (n) of points (n, 3) from the slope."""
    normal = torch.nn.functional.normalize(torch.tensor(SLOPE.normal, dtype=torch.float64), dim=0)
    return (points - normal.new_tensor(SLOPE.point)) @ normal


def _found(rendered, points, reach=3.0 * FOOTPRINT):
    """Which of what the first image's pixels show (h, w) has one of points (n, 3) within reach; every sixth pixel."""
    shown = rendered.points[0, ::6, ::6]
    return torch.cdist(shown.reshape(-1, 3), points).amin(dim=1).view(shown.shape[:2]) < reach


def _seen_by_all(rendered, margin=10.0):
    """Which of every sixth pixel of the first image all images show, `margin` pixels from their borders (h, w)."""
    shown = rendered.points[0, ::6, ::6]
    pixels, _ = rendered.cameras[:, None].project(shown.reshape(-1, 3))
    room = torch.minimum(pixels, pixels.new_tensor((160.0, 120.0)) - pixels).amin(dim=(0, 2))
    return (room > margin).view(shown.shape[:2])


def test_the_surface_is_found_where_all_images_see_it(finished, slope):
    _, _, _, dense = finished

    common = _seen_by_all(slope)

    assert common.sum() > 150
    assert _found(slope, dense.cloud.points)[common].double().mean() > 0.97


def test_points_lie_on_the_surface_and_face_as_it_does(finished, slope):
    _, _, _, dense = finished

    off = _heights(dense.cloud.points).abs()

    normal = torch.nn.functional.normalize(torch.tensor(SLOPE.normal, dtype=torch.float64), dim=0)
    turned = torch.rad2deg(torch.acos((dense.cloud.normals @ normal).clamp(-1.0, 1.0)))
    assert off.median() < 0.1 * FOOTPRINT
    assert off.quantile(0.95) < 0.5 * FOOTPRINT
    assert off.max() < 2.0 * FOOTPRINT
    assert turned.median() < 3.0
    assert turned.quantile(0.95) < 12.0


def test_sigma_tells_the_size_of_the_errors(finished):
    _, _, _, dense = finished

    ratio = _heights(dense.cloud.points).abs() / dense.cloud.sigma

    assert 0.2 < ratio.median() < 1.4
    assert (ratio < 4.0).double().mean() > 0.9


def test_the_cloud_is_that_of_the_patches(finished, slope):
    _, _, options, dense = finished
    cloud, patches = dense.cloud, dense.patches

    column, row = patches.pixels.long().unbind(dim=-1)
    painted = slope.images[patches.reference, row, column].round().clamp(0, 255).byte()

    for name in ("points", "normals", "sigma", "score", "views", "reference"):
        assert torch.equal(getattr(cloud, name), getattr(patches, name)), name
    assert torch.equal(cloud.colors, painted[:, None].expand(-1, 3))
    assert cloud.length_unit == "cm"
    assert (cloud.views >= options.min_views).all()
    assert ((cloud.score > options.min_score) & (cloud.score <= 1.0 + 1e-6)).all()
    assert (cloud.sigma > 0.0).all()


def test_every_patch_lies_on_the_ray_of_its_pixel(finished, slope):
    _, _, options, dense = finished

    pixels, valid = slope.cameras[dense.patches.reference].project(dense.patches.points)

    assert valid.all()
    off = (pixels - dense.patches.pixels).norm(dim=-1)
    assert off.max() < (1e-6 if options.method == "patch" else 0.5)  # fused ones have moved along their normals


def test_each_image_gets_a_map_of_what_it_shows(finished, slope):
    _, scene, options, dense = finished

    maps = list(depth_maps(dense, scene, options))

    assert [m.name for m in maps] == ["0.png", "1.png", "2.png"]
    for image, seen in enumerate(maps):
        truth = slope.points[image, 1:120:3, 1:159:3]
        assert seen.valid.double().mean() > 0.4
        assert (seen.points - truth).norm(dim=-1)[seen.valid].median() < 0.2 * FOOTPRINT


@methods
def test_masked_ground_stays_empty(slope, tmp_path, method):
    capture, scene = write_capture(slope, tmp_path), sparse_scene(slope)
    hidden = (slope.points[..., 0].abs() < 6.0) & (slope.points[..., 1].abs() < 6.0)
    for image, name in enumerate(capture.names):
        write_mask(capture, name, ~hidden[image])

    points = densify(replace(scene, capture=capture), OPTIONS[method]).cloud.points

    inside = points[:, :2].abs().amax(dim=-1)
    assert not (inside < 6.0 - FOOTPRINT).any()
    assert (inside < 20.0).sum() > 200
    assert len(points) > 500


@methods
def test_ground_without_texture_stays_empty(tmp_path, method):
    paint = marble()
    photographs = _photographs(texture=lambda points: np.where(points[..., 0] < 0.0, paint(points), 128.0))

    points = densify(photographed_scene(photographs, tmp_path), OPTIONS[method]).cloud.points

    assert (points[:, 0] < 0.0).sum() > 400
    assert not (points[:, 0] > 6.0 * FOOTPRINT).any()
    assert _heights(points).abs().quantile(0.95) < 0.5 * FOOTPRINT


@methods
def test_a_flat_bottom_is_found_however_narrow_its_range_of_distances(tmp_path, method):
    photographs = _photographs(board=Board((0.0, 0.0, -40.0)))

    points = densify(photographed_scene(photographs, tmp_path), OPTIONS[method]).cloud.points

    assert _found(photographs, points)[_seen_by_all(photographs)].double().mean() > 0.97
    assert (points[:, 2] + 40.0).abs().median() < 0.1 * FOOTPRINT


@methods
def test_two_images_are_enough(tmp_path, method):
    photographs = _photographs(2)

    dense = densify(photographed_scene(photographs, tmp_path), OPTIONS[method])

    assert _found(photographs, dense.cloud.points)[_seen_by_all(photographs)].double().mean() > 0.97
    assert _heights(dense.cloud.points).abs().median() < 0.1 * FOOTPRINT
    assert (dense.cloud.views == 2).all()


@methods
def test_without_refraction_in_the_model_the_bottom_is_not_where_it_is(slope, tmp_path, method):
    """The photographs and poses are right, but nobody told of the water."""
    dry = replace(slope, cameras=slope.cameras.as_pinhole())
    scene = sparse_scene(dry)

    points = densify(
        replace(scene, capture=write_capture(slope, tmp_path)), replace(OPTIONS[method], cell=6)
    ).cloud.points

    assert not len(points) or _heights(points).abs().median() > 3.0 * FOOTPRINT


def test_an_image_without_a_pose_takes_no_part(slope, tmp_path):
    capture, scene = write_capture(slope, tmp_path), sparse_scene(slope)
    known, views = scene.observations.view != 1, replace(scene.views, registered=torch.tensor([True, False, True]))
    scene = replace(scene, views=views, observations=scene.observations[known], accepted=scene.accepted[known])

    dense = densify(replace(scene, capture=capture), OPTIONS["patch"])

    assert len(dense.cloud) > 800
    assert not (dense.patches.reference == 1).any()
    assert not ((dense.patches.others == 1) & dense.patches.visible).any()
    assert [m.name for m in depth_maps(dense, scene, OPTIONS["patch"])] == ["0.png", "2.png"]


def test_without_sparse_points_it_says_that_they_are_missing(slope, tmp_path):
    scene = sparse_scene(slope)
    bare = replace(scene, accepted=torch.zeros_like(scene.accepted)).trimmed()

    with pytest.raises(DenseError, match="no sparse points, which say where to look; run the sparse"):
        densify(replace(bare, capture=write_capture(slope, tmp_path)), OPTIONS["patch"])


def test_photographs_of_two_levels_of_the_water_show_one_surface(slope, tmp_path):
    """The second one was taken when the water stood higher: taken for that of the others it would bend the slope."""
    rise = torch.tensor((0.0, 0.0, 3.0), dtype=torch.float64)
    low = tuple((torch.tensor(SLOPE.point, dtype=torch.float64) - rise).tolist())
    lower = replace(slope.cameras, center_in_world=slope.cameras.center_in_world - rise)
    plain = marble()
    later = render([Board(low, SLOPE.normal)], lower, lambda points: plain(points + rise.numpy()), 1.33)
    images = slope.images.clone()
    images[1] = later.images[1]
    scene = photographed_scene(replace(slope, images=images), tmp_path)
    of_later = scene.observations.view == 1
    pixels = scene.observations.pixels.clone()
    pixels[of_later] = lower[1].project(scene.points[scene.observations.point[of_later]] - rise)[0]
    levels = replace(Interfaces.level(1.33).repeated(2), offset=torch.tensor((0.0, 3.0), dtype=torch.float64))
    seen = replace(scene.observations, pixels=pixels)
    two = replace(
        scene,
        interfaces=levels,
        views=replace(scene.views, interface=torch.tensor((0, 1, 0))),
        observations=seen,
    )

    found = densify(two, OPTIONS["patch"]).cloud
    mistaken = densify(replace(two, interfaces=Interfaces.level(1.33), views=scene.views), OPTIONS["patch"]).cloud

    assert len(found) > 800
    assert float(_heights(found.points).abs().median()) < 0.1 * FOOTPRINT
    assert float(_heights(mistaken.points).abs().median()) > 3.0 * float(_heights(found.points).abs().median())


def test_identical_views_are_refused(slope, tmp_path):
    same = torch.zeros(3, dtype=torch.long)
    still = replace(slope, cameras=slope.cameras[same], images=slope.images[same], points=slope.points[same])

    with pytest.raises(DenseError, match="no two of 3 registered images see common points at an angle"):
        densify(photographed_scene(still, tmp_path), OPTIONS["patch"])


def test_a_photograph_that_is_gone_is_named(slope, tmp_path):
    capture = write_capture(slope, tmp_path)
    capture.paths[2].unlink()

    with pytest.raises(CaptureError, match=re.escape(str(capture.paths[2]))):
        densify(replace(sparse_scene(slope), capture=capture), OPTIONS["patch"])


def test_the_method_that_leaves_it_at_sparse_points_is_refused(slope, tmp_path):
    with pytest.raises(ValueError, match="method is 'none', but must be 'patch' or 'depthmap'"):
        densify(photographed_scene(slope, tmp_path), DenseOptions(method="none"))
