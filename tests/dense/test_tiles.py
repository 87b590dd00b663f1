"""Tiles cover an image, hold all that they need of the others, and give what the whole image gives."""

from dataclasses import replace

import pytest
import torch

from tests.dense.rendered_captures import CountingRecorder, images_of, sparse_scene, write_capture, write_mask
from tests.dense.rendered_scenes import Board, cameras_around, marble, render
from torchrefrac.dense import DenseOptions, densify
from torchrefrac.dense.images import Images
from torchrefrac.dense.neighbours import Neighbourhood
from torchrefrac.dense.rays import PixelRays
from torchrefrac.dense.scope import scopes, tile_boxes

OPTIONS = DenseOptions(method="patch")
SMALL = replace(OPTIONS, max_tile=81)
NEAR, FAR = -8.0, 70.0


def _neighbourhood(cameras, others=(2, 1)):
    """Of the first image, without sparse points."""
    ids, none = torch.tensor([0, *others]), torch.zeros(0, 3, dtype=torch.float64)
    return Neighbourhood(ids, cameras[ids], NEAR, FAR, none, none[:, :2])


@pytest.fixture(scope="module")
def shore():
    """Four photographs of a slope that rises out of the water."""
    return render([Board((0.0, 0.0, -10.0), (0.5, 0.1, 1.0))], cameras_around(4, 45.0, -5.0, 1.33), marble(), 1.33)


@pytest.fixture
def images(shore, tmp_path):
    return images_of(shore, tmp_path)


@pytest.mark.parametrize("cell", [1, 3, 4])
@pytest.mark.parametrize(("width", "height", "tile"), [(160, 120, 81), (200, 31, 48), (17, 90, 30), (60, 60, 1)])
def test_every_cell_lies_in_a_tile_of_whole_cells(cell, width, height, tile):
    options = DenseOptions(cell=cell, max_tile=tile)
    covered = torch.zeros(height // cell, width // cell, dtype=torch.long)

    boxes = list(tile_boxes(width, height, options))

    for left, top, right, bottom in boxes:
        assert left % cell == top % cell == 0
        assert 0 <= left < right <= width
        assert 0 <= top < bottom <= height
        assert max(right - left, bottom - top) <= max(tile, 3 * cell)
        covered[top // cell : bottom // cell, left // cell : right // cell] += 1
    assert (covered > 0).all()
    assert len(set(boxes)) == len(boxes)


@pytest.mark.parametrize("most", [160, 170, 2048])
def test_a_small_image_is_one_tile(shore, images, most):
    made = list(scopes(_neighbourhood(shore.cameras), images, replace(OPTIONS, max_tile=most)))

    assert [scope.tile for scope in made] == [(0, 0, 160, 120)]
    assert made[0].ids.tolist() == [0, 2, 1]
    assert torch.equal(made[0].atlas.copy(2), images.grey(1).float())
    assert made[0].allowed is None
    assert (made[0].near, made[0].far) == (NEAR, FAR)


def test_the_parts_hold_every_projection_of_the_tile_with_its_window(shore, images, draw):
    margin = 0.5 * OPTIONS.window * 2 ** (OPTIONS.levels - 1)
    made = list(scopes(_neighbourhood(shore.cameras), images, SMALL))

    for scope in made:
        left, top, right, bottom = scope.tile
        pixels = torch.stack((draw.uniform(left, right, 2000), draw.uniform(top, bottom, 2000)), dim=-1)
        points = PixelRays.cast(shore.cameras[0], pixels).at(draw.uniform(NEAR, FAR, 2000))
        there = dict(zip(scope.ids.tolist(), range(len(scope.ids)), strict=True))
        for image in (0, 1, 2):
            at, inside = shore.cameras[image].project(points, inside_image=True)
            if image not in there:
                assert not inside.any()
                continue
            low = scope.atlas.origin[there[image]]
            high = low + scope.atlas.size[there[image], 0]
            size = at.new_tensor((160.0, 120.0))
            assert (at[inside] - low >= torch.minimum(at[inside], at.new_tensor(margin))).all()
            assert (high - at[inside] >= torch.minimum(size - at[inside], at.new_tensor(margin))).all()
    assert len(made) > 2
    assert any((scope.atlas.size[:, 0] < 100).any() for scope in made)


def test_parts_show_what_the_whole_images_show(shore, images, draw):
    whole = next(scopes(_neighbourhood(shore.cameras), images, OPTIONS))

    for scope in scopes(_neighbourhood(shore.cameras), images, SMALL):
        for local, image in enumerate(scope.ids.tolist()):
            low = scope.atlas.origin[local]
            room = scope.atlas.size[local, 0] - 24.0
            pixels = (low + 12.0 + draw.uniform(0.0, 1.0, 100, 2) * room)[:, None]
            there = torch.full((100,), whole.ids.tolist().index(image))
            for level in range(OPTIONS.levels):
                copies = torch.full((100,), level)
                part = scope.atlas.sample(torch.full((100,), local), copies, pixels)
                torch.testing.assert_close(part, whole.atlas.sample(there, copies, pixels), rtol=0.0, atol=0.1)
            assert torch.equal(scope.cameras.center_in_world[local], shore.cameras.center_in_world[image])


def test_an_image_that_shows_nothing_of_a_tile_is_left_out(shore, images):
    """The third camera looks away."""
    rotation = shore.cameras.cam_from_world_rotation.clone()
    rotation[2, [0, 2]] *= -1.0
    cameras = replace(shore.cameras, cam_from_world_rotation=rotation)

    with_another = list(scopes(_neighbourhood(cameras), images, SMALL))
    alone = list(scopes(_neighbourhood(cameras, (2,)), images, SMALL))

    assert {tuple(scope.ids.tolist()) for scope in with_another} == {(0, 1)}
    assert not alone


def test_masks_are_handed_on(shore, tmp_path):
    capture = write_capture(shore, tmp_path)
    allowed = torch.arange(160).expand(120, 160) < 70
    write_mask(capture, "2.png", allowed)

    for options in (OPTIONS, SMALL):
        for scope in scopes(_neighbourhood(shore.cameras), Images(capture), options):
            local = scope.ids.tolist()
            assert scope.allowed is not None
            assert scope.allowed[0].all()
            assert torch.equal(scope.allowed[local.index(2)], allowed)


@pytest.mark.parametrize("method", ["patch", "depthmap"])
def test_tiles_give_the_surface_that_the_whole_image_gives_and_no_cell_twice(shore, tmp_path, method):
    three = replace(shore, cameras=shore.cameras[torch.arange(3)], images=shore.images[:3], points=shore.points[:3])
    capture, scene = write_capture(three, tmp_path), sparse_scene(three)

    recorders = CountingRecorder(), CountingRecorder()
    whole, tiled = (
        densify(replace(scene, capture=capture), replace(OPTIONS, method=method, max_tile=size), recorder).patches
        for size, recorder in zip((160, 90), recorders, strict=True)
    )

    normal = torch.nn.functional.normalize(torch.tensor((0.5, 0.1, 1.0), dtype=torch.float64), dim=0)
    middle = normal.new_tensor((0.0, 0.0, -10.0))
    off_whole, off_tiled = (((patches.points - middle) @ normal).abs() for patches in (whole, tiled))
    place = torch.cat((tiled.reference[:, None], (tiled.pixels / OPTIONS.cell).long()), dim=1)
    assert len(whole) > 1000
    assert abs(len(tiled) - len(whole)) < 0.02 * len(whole)
    assert float(off_tiled.median()) == pytest.approx(float(off_whole.median()), rel=0.1)
    assert (torch.cdist(whole.points, tiled.points).amin(dim=1) < 0.5).double().mean() > 0.98
    assert (tiled.points[:, 2] > 0.0).sum() > 100
    assert len(place.unique(dim=0)) == len(tiled)
    for recorder in recorders:
        assert recorder.done == recorder.total == 3 * (120 // 3) * (160 // 3)
