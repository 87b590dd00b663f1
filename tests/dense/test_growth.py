"""Growth covers what can be compared, tries every place a few times at most, and ends."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.dense.rendered_scenes import Board, cameras_around, marble, render
from torchrefrac.dense.growth import RINGS, TRIES, UNTRIED, Cells, grow
from torchrefrac.dense.options import DenseOptions
from torchrefrac.dense.patches import Patches

OPTIONS = DenseOptions()
BOTTOM = -40.0
NEAR, FAR = 30.0, 60.0


@pytest.fixture(scope="module")
def half_painted():
    """Three photographs of a flat bottom that has a texture where x < 0 only."""
    paint = marble()

    def texture(points):
        return np.where(points[..., 0] < 0.0, paint(points), 128.0)

    return render([Board((0.0, 0.0, BOTTOM))], cameras_around(3, 30.0, -30.0, 1.33), texture, 1.33)


@pytest.fixture
def scope(half_painted):
    return half_painted.scope(NEAR, FAR, OPTIONS)


@pytest.fixture
def grid(scope):
    """Empty cells, 7 x 9 of 3 pixels, that begin in the middle of the image."""
    return Cells(replace(scope, tile=(30, 21, 57, 42)), 3)


def _patches(points, normals, score):
    """Of which nothing else is known."""
    none = torch.zeros_like(score)
    no_view, table = none.long(), none.long()[:, None]
    return Patches(no_view, points[:, :2], points, normals, none, none, score, table, table > 0)


def _labelled(score):
    """Patches by whose points and normals one can tell which score (k) they came with."""
    return _patches(score[:, None].expand(-1, 3), -score[:, None].expand(-1, 3), score)


def test_cells_lie_where_their_centres_are(grid):
    at, inside = grid.index(grid.pixels)

    assert (grid.rows, grid.columns) == (7, 9)
    assert grid.pixels[0].tolist() == [31.5, 22.5]
    assert torch.equal(at, torch.arange(63))
    assert inside.all()


def test_pixels_beside_the_tile_lie_in_no_cell(grid):
    beside = torch.tensor([[29.9, 30.0], [57.1, 30.0], [40.0, 20.9], [40.0, 42.1], [-5.0, -5.0]], dtype=torch.float64)
    corners = torch.tensor([[30.0, 21.0], [56.9, 41.9]], dtype=torch.float64)

    assert not grid.index(beside)[1].any()
    assert grid.index(corners)[0].tolist() == [0, 62]
    assert grid.index(corners)[1].all()


@pytest.mark.parametrize("count", [0, 1, 20, 50_000])
def test_of_several_planes_for_one_cell_the_best_stays(grid, draw, generator, count):
    best = np.full(63, UNTRIED)
    for _ in range(3):
        cells, score = torch.randint(63, (count,), generator=generator), draw.uniform(0.0, 1.0, count)
        np.maximum.at(best, cells.numpy(), score.numpy())

        grid.fill(cells, _labelled(score))

        held = torch.from_numpy(best)
        assert torch.equal(grid.score, held)
        assert torch.equal(grid.filled, held >= 0.0)
        assert torch.equal(grid.points[grid.filled], _labelled(held).points[grid.filled])
        assert torch.equal(grid.normals[grid.filled], _labelled(held).normals[grid.filled])


def test_a_filled_cell_is_counted_once(grid):
    score = torch.tensor([0.5, 0.6, 0.7], dtype=torch.float64)

    grid.fill(torch.tensor([4, 4, 9]), _labelled(score))
    first, again = grid.filled_since(), grid.filled_since()
    grid.fill(torch.tensor([4, 5, 9]), _labelled(score + 0.1))

    assert (first, again, grid.filled_since()) == (2, 0, 1)


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 1.0])
def test_every_empty_cell_near_filled_ones_gets_the_best_of_the_nearest_ring(grid, draw, share):
    score = draw.uniform(0.1, 1.0, 63)
    filled = (draw.uniform(0.0, 1.0, 63) < share).nonzero()[:, 0]
    grid.fill(filled, _labelled(score[filled]))

    cells, source = grid.frontier()

    expected = {}
    for cell in set(range(63)) - set(filled.tolist()):
        row, column = divmod(cell, 9)
        ring = {n: max(abs(n // 9 - row), abs(n % 9 - column)) for n in filled.tolist()}
        near = {n: r for n, r in ring.items() if r <= RINGS}
        if near:
            expected[cell] = min(near, key=lambda n: (near[n], -float(score[n])))
    assert dict(zip(cells.tolist(), source.tolist(), strict=True)) == expected


def test_a_place_is_tried_again_for_a_better_plane_only_and_not_more_than_a_few_times(grid):
    """The neighbours of cell 40 are filled one after the other, by turns better and worse than all before."""
    offered = 0
    for neighbour, score in zip(
        (30, 31, 32, 39, 41, 48, 49, 50), (0.4, 0.3, 0.5, 0.2, 0.6, 0.5, 0.7, 0.8), strict=True
    ):
        value = torch.tensor([score], dtype=torch.float64)
        grid.fill(torch.tensor([neighbour]), _labelled(value))

        cells, source = grid.frontier()

        if 40 in cells.tolist():
            offered += 1
            assert int(source[cells == 40]) == neighbour
            assert score in (0.4, 0.5, 0.6)
        assert 40 not in grid.frontier()[0].tolist()
    assert offered == TRIES


def test_a_place_that_failed_from_afar_is_tried_again_from_beside_it(grid):
    first, worse = torch.tensor([0.9], dtype=torch.float64), torch.tensor([0.8], dtype=torch.float64)
    grid.fill(torch.tensor([31]), _labelled(first))
    grid.frontier()

    grid.fill(torch.tensor([32]), _labelled(worse))
    cells, source = grid.frontier()

    again = dict(zip(cells.tolist(), source.tolist(), strict=True))
    assert again[33] == 32
    assert 30 not in again


def test_what_fails_everywhere_is_given_up(grid):
    score = torch.tensor([0.9], dtype=torch.float64)
    grid.fill(torch.tensor([31]), _labelled(score))

    waves = [len(grid.frontier()[0]) for _ in range(3)]

    assert waves == [24, 0, 0]


def test_from_one_seed_the_whole_textured_part_is_covered_and_nothing_else(half_painted, scope):
    cells = Cells(scope, OPTIONS.cell)
    shown, _ = half_painted.at(cells.pixels)
    seed = (shown - shown.new_tensor((-8.0, 0.0, BOTTOM))).norm(dim=-1).argmin()
    up = torch.tensor([[0.1, -0.1, 1.0]], dtype=torch.float64)
    cells.fill(
        seed[None], _patches(shown[seed][None], torch.nn.functional.normalize(up, dim=-1), shown.new_tensor([0.8]))
    )

    patches = Patches.together(list(grow(scope, cells, OPTIONS)))

    reach = 0.5 * OPTIONS.window * 1.5  # pixels from a window's middle to its corners
    pixels, _ = half_painted.cameras[:, None].project(shown)
    room = torch.minimum(pixels, pixels.new_tensor((160.0, 120.0)) - pixels).amin(dim=(0, 2))
    inside = room > reach + 2.0
    footprint = 0.6
    textured, bare = (shown[:, 0] < -2.0 * footprint) & inside, shown[:, 0] > reach * footprint
    assert textured.sum() > 500
    assert cells.filled[textured].double().mean() > 0.99
    assert not cells.filled[bare].any()
    assert bare.sum() > 500
    error = (patches.points[:, 2] - BOTTOM).abs()
    assert error.median() < 0.05
    assert error[patches.points[:, 0] < -reach * footprint].max() < 0.5 * footprint
    assert len(patches) == int(cells.filled.sum()) - 1
    assert int(cells.tries.max()) <= TRIES


def test_each_patch_fills_the_cell_that_it_is_centred_in(half_painted, scope):
    cells = Cells(scope, OPTIONS.cell)
    shown, normals = half_painted.at(cells.pixels)
    seed = (shown - shown.new_tensor((-8.0, 0.0, BOTTOM))).norm(dim=-1).argmin()[None]
    cells.fill(seed, _patches(shown[seed], normals[seed], shown.new_tensor([0.8])))

    patches = Patches.together(list(grow(scope, cells, OPTIONS)))

    at, inside = cells.index(patches.pixels)
    assert inside.all()
    assert len(at.unique()) == len(at)
    assert torch.equal(cells.points[at], patches.points)
    assert torch.equal(cells.score[at], patches.score)


def test_without_a_seed_nothing_grows(scope):
    assert not list(grow(scope, Cells(scope, OPTIONS.cell), OPTIONS))
