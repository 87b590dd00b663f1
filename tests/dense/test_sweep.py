"""The sweep finds surfaces in photographs whose making knows nothing of it."""

from dataclasses import replace

import pytest
import torch

from tests.dense.rendered_scenes import FOCAL, Board, cameras_around, marble, render
from torchrefrac.dense.atlas import Atlas
from torchrefrac.dense.options import DenseOptions, SweepOptions
from torchrefrac.dense.sweeping.sweep import sweep

OPTIONS = DenseOptions(sweep=SweepOptions(level=1))
CELLS = (160 // 3) * (120 // 3)
FLAT = Board((0.0, 0.0, -40.0))


@pytest.fixture(scope="module")
def pond():
    """Four photographs of a flat bottom."""
    return _photographs([FLAT], 4)


def _photographs(boards, count, index_ratio=1.33, height=30.0, aim=-30.0, contrast=45.0):
    cameras = cameras_around(count, height, aim, index_ratio)
    return render(boards, cameras, marble(contrast), index_ratio)


def _errors(rendered, pixels, planes):
    """In pixel footprints: how far each guess is from what its pixel shows (k)."""
    points, _ = rendered.at(pixels)
    footprint = (points - rendered.cameras.center_in_world[0]).norm(dim=-1) / FOCAL
    return (planes.points - points).norm(dim=-1) / footprint


def _angles_deg(rendered, pixels, planes):
    """Between each guess's normal and the true one (k)."""
    _, normals = rendered.at(pixels)
    return torch.rad2deg(torch.acos((planes.normals * normals).sum(dim=-1).abs().clamp(max=1.0)))


@pytest.mark.parametrize(
    ("boards", "count", "index_ratio", "height", "aim", "near", "far"),
    [
        pytest.param([FLAT], 4, 1.33, 30.0, -30.0, 30.0, 70.0, id="a flat bottom"),
        pytest.param([Board((0.0, 0.0, -40.0), (0.4, -0.2, 1.0))], 4, 1.33, 30.0, -30.0, 20.0, 90.0, id="a slope"),
        pytest.param([FLAT], 2, 1.33, 30.0, -30.0, 30.0, 70.0, id="two images"),
        pytest.param([Board((0.0, 0.0, 10.0), (0.1, 0.1, 1.0))], 3, 1.33, 60.0, 10.0, -40.0, -4.0, id="land"),
        pytest.param([Board((0.0, 0.0, 0.0), (0.6, 0.1, 1.0))], 4, 1.33, 40.0, 0.0, -20.0, 20.0, id="a shore"),
        pytest.param([Board((0.0, 0.0, -40.0), (0.2, 0.1, 1.0))], 3, 1.0, 30.0, -30.0, 20.0, 70.0, id="no refraction"),
    ],
)
def test_guesses_lie_within_a_fraction_of_a_pixel(boards, count, index_ratio, height, aim, near, far):
    rendered = _photographs(boards, count, index_ratio, height, aim)

    pixels, planes, score = sweep(rendered.scope(near, far, OPTIONS), OPTIONS)

    error = _errors(rendered, pixels, planes)
    assert len(pixels) > 0.8 * CELLS
    assert error.median() < 0.5
    assert (error < 2.0).double().mean() > 0.9
    assert _angles_deg(rendered, pixels, planes).median() < 8.0
    assert ((score >= OPTIONS.sweep.min_score) & (score <= 1.0)).all()


def test_guesses_lie_on_the_rays_of_their_cells(pond):
    scope = pond.scope(30.0, 70.0, OPTIONS)

    pixels, planes, _ = sweep(scope, OPTIONS)

    seen, valid = pond.cameras[0].project(planes.points)
    centers = {tuple(center) for center in scope.centers(OPTIONS.cell).view(-1, 2).tolist()}
    assert valid.all()
    torch.testing.assert_close(seen, pixels, rtol=0.0, atol=1e-9)
    assert {tuple(pixel) for pixel in pixels.tolist()} <= centers


def test_water_left_out_of_account_shows():
    rendered = _photographs([FLAT], 4)
    blind = replace(rendered, cameras=rendered.cameras.as_pinhole())

    pixels, planes, _ = sweep(blind.scope(20.0, 70.0, OPTIONS), OPTIONS)

    assert _errors(rendered, pixels, planes).median() > 10.0


def test_an_edge_parts_two_surfaces():
    upper = Board((3.0, 2.0, -30.0), (0.2, 0.1, 1.0), reach=9.0)
    rendered = _photographs([Board((0.0, 0.0, -42.0)), upper], 4)

    pixels, planes, _ = sweep(rendered.scope(20.0, 70.0, OPTIONS), OPTIONS)

    error = _errors(rendered, pixels, planes)
    on_upper = rendered.at(pixels)[1][:, 0] > 0.1
    assert on_upper.sum() > 200
    assert error[on_upper].median() < 0.5
    assert error[~on_upper].median() < 0.5
    assert (error > 3.0).double().mean() < 0.12


@pytest.mark.parametrize("noise", [0.0, 0.3])
def test_walls_without_texture_give_no_guess(noise, draw):
    rendered = _photographs([FLAT], 4, contrast=0.0)
    rendered = replace(rendered, images=rendered.images + noise * draw.normal(*rendered.images.shape).float())

    pixels, planes, score = sweep(rendered.scope(30.0, 70.0, OPTIONS), OPTIONS)

    assert len(pixels) == len(planes.points) == len(planes.normals) == len(score) == 0


def test_a_surface_outside_the_range_gives_no_guess(pond):
    pixels, _, _ = sweep(pond.scope(52.0, 80.0, OPTIONS), OPTIONS)

    assert len(pixels) < 0.02 * CELLS


def test_masked_pixels_of_the_reference_get_no_guess(pond):
    allowed = torch.ones(4, 120, 160, dtype=torch.bool)
    allowed[0, :, :80] = False

    pixels, _, _ = sweep(pond.scope(30.0, 70.0, OPTIONS, allowed), OPTIONS)

    assert len(pixels) > 0.4 * CELLS
    assert (pixels[:, 0] >= 80).all()


def test_what_others_mask_is_not_compared(pond):
    """Half of one image is painted over, and masked."""
    allowed = torch.ones(4, 120, 160, dtype=torch.bool)
    allowed[3, :, :80] = False
    spoilt = pond.images.clone()
    spoilt[3, :, :80] = 40.0 * torch.rand(120, 80, generator=torch.Generator().manual_seed(1)) + 100.0
    rendered = replace(pond, images=spoilt)

    pixels, planes, _ = sweep(rendered.scope(30.0, 70.0, OPTIONS, allowed), OPTIONS)
    nothing, _, _ = sweep(pond.scope(30.0, 70.0, OPTIONS, allowed & (torch.arange(4) == 0)[:, None, None]), OPTIONS)

    assert len(pixels) > 0.75 * CELLS
    assert _errors(rendered, pixels, planes).median() < 0.5
    assert len(nothing) == 0


def test_a_tile_of_parts_of_the_images_gives_what_the_whole_gives(pond):
    whole = pond.scope(30.0, 70.0, OPTIONS)
    left, top, right, bottom = 36, 24, 96, 84
    parts = [pond.images[0, :104, 8:128], *pond.images[1:]]
    origin = torch.tensor([[8.0, 0.0], [0.0, 0.0], [0.0, 0.0], [0.0, 0.0]])
    tile = replace(whole, atlas=Atlas.build(parts, OPTIONS.levels, origin), tile=(left, top, right, bottom))

    pixels, planes, _ = sweep(tile, OPTIONS)
    all_pixels, all_planes, _ = sweep(whole, OPTIONS)

    row = {tuple(pixel): i for i, pixel in enumerate(all_pixels.tolist())}
    both = torch.tensor([(i, row[tuple(p)]) for i, p in enumerate(pixels.tolist()) if tuple(p) in row])
    apart = (planes.points[both[:, 0]] - all_planes.points[both[:, 1]]).norm(dim=-1)
    assert ((pixels > torch.tensor((left, top))) & (pixels < torch.tensor((right, bottom)))).all()
    assert len(both) > 0.95 * 20 * 20
    assert apart.median() < 0.1  # a fifth of a footprint: the tile's distances are its own
    assert _errors(pond, pixels, planes).median() < 0.5


def test_more_planes_than_are_needed_change_nothing(pond):
    scope = pond.scope(30.0, 70.0, OPTIONS)
    many = replace(OPTIONS, sweep=replace(OPTIONS.sweep, planes=300))

    _, few, _ = sweep(scope, OPTIONS)
    _, more, _ = sweep(scope, many)

    assert abs(len(more.points) - len(few.points)) < 0.02 * CELLS
    assert abs(more.points[:, 2].median() - few.points[:, 2].median()) < 0.02


def test_a_range_without_any_extent_gives_no_guess(pond):
    pixels, planes, score = sweep(pond.scope(50.0, 50.0, OPTIONS), OPTIONS)

    assert len(pixels) == len(planes.points) == len(score) == 0


def test_a_range_that_reaches_behind_the_camera_does_no_harm(pond):
    pixels, planes, _ = sweep(pond.scope(-60.0, 70.0, OPTIONS), OPTIONS)

    assert len(pixels) > 0.8 * CELLS
    assert _errors(pond, pixels, planes).median() < 0.5
