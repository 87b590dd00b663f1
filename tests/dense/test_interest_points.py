"""Corners and blobs: at planted places, spread evenly, and none where there is nothing to see."""

import subprocess
import sys

import pytest
import torch
from torch import Tensor

from torchrefrac.dense.matching.interest_points import BLOB, CORNER, detect_interest_points


def test_blobs_are_found_at_their_centres(draw):
    rows, columns = torch.meshgrid(torch.arange(6) * 24.0 + 20.0, torch.arange(8) * 24.0 + 20.0, indexing="ij")
    centers = torch.stack((columns, rows), dim=-1).reshape(-1, 2).double() + draw.uniform(-0.5, 0.5, 48, 2)
    sign = torch.where(torch.arange(48) % 2 == 0, 60.0, -60.0).double()  # bright and dark
    image = 100.0 + _bumps(160, 210, centers, sign, spread=1.8)

    found = detect_interest_points(image)

    blobs = found.pixels[found.kind == BLOB]
    gap = torch.cdist(centers, blobs).amin(dim=1)
    assert float(gap.max()) < 0.05


@pytest.mark.parametrize(("kind", "gap"), [(CORNER, 0.2), (BLOB, 0.05)])
def test_a_point_moves_with_the_image_by_parts_of_a_pixel(draw, kind: int, gap: float):
    centers, height = draw.uniform(10.0, 190.0, 400, 2), draw.uniform(-40.0, 40.0, 400)
    shift = torch.tensor((0.3, -0.4), dtype=torch.float64)

    first = detect_interest_points(128.0 + _bumps(200, 200, centers, height, spread=3.0))
    second = detect_interest_points(128.0 + _bumps(200, 200, centers + shift, height, spread=3.0))

    before, after = first.pixels[first.kind == kind], second.pixels[second.kind == kind]
    assert len(before) > 100
    assert float(torch.cdist(before + shift, after).amin(dim=1).median()) < gap
    assert float(torch.cdist(before, after).amin(dim=1).median()) > 0.4


def test_the_corners_of_squares_are_corners():
    image = torch.full((128, 128), 60.0)
    image[32:96, 32:96] = 180.0

    found = detect_interest_points(image)

    corners = found.pixels[found.kind == CORNER]
    expected = torch.tensor([[32.0, 32.0], [96.0, 32.0], [32.0, 96.0], [96.0, 96.0]], dtype=torch.float64)
    assert corners.shape == (4, 2)
    assert float(torch.cdist(expected, corners).amin(dim=1).max()) < 2.0
    mirrored = 128.0 - corners
    assert float(torch.cdist(corners, mirrored).amin(dim=1).max()) < 1e-3


def test_along_a_straight_edge_there_is_nothing():
    y, x = torch.meshgrid(torch.arange(128.0), torch.arange(128.0), indexing="ij")
    image = 40.0 + 160.0 * torch.sigmoid(2.0 * (0.31 * x + y - 80.0))

    found = detect_interest_points(image)

    assert not bool((found.kind == CORNER).any())


@pytest.mark.parametrize("kind", ["flat", "ramp", "noise of one grey level"])
def test_where_there_is_nothing_to_see_nothing_is_found(draw, kind: str):
    image = torch.full((256, 320), 90.0, dtype=torch.float64)
    if kind == "ramp":
        image = image + 0.3 * torch.arange(320)
    elif kind == "noise of one grey level":
        image = image + draw.normal(256, 320)

    found = detect_interest_points(image)

    assert len(found) == 0
    assert found.pixels.shape == (0, 2)


def test_no_square_holds_more_than_it_may_and_the_strongest_stay(draw):
    image = (255.0 * draw.uniform(0.0, 1.0, 150, 230)).round().to(torch.uint8)

    everything = detect_interest_points(image, per_cell=10_000, cell=40)
    found = detect_interest_points(image, per_cell=3, cell=40)

    square = (found.pixels / 40).long() @ torch.tensor((1, 100)) + 10_000 * found.kind
    of_all = (everything.pixels / 40).long() @ torch.tensor((1, 100)) + 10_000 * everything.kind
    assert square.unique(return_counts=True)[1].max() == 3
    for name in of_all.unique():
        torch.testing.assert_close(found.pixels[square == name], everything.pixels[of_all == name][:3])


def test_points_lie_off_the_border(draw):
    found = detect_interest_points(255.0 * draw.uniform(0.0, 1.0, 100, 140))

    assert float(found.pixels.min()) > 3.0
    assert bool((found.pixels < torch.tensor((137.0, 97.0))).all())


def test_equal_neighbours_count_once():
    image = torch.full((64, 64), 50.0, dtype=torch.float64)
    image[30:32, 40:42] = 150.0  # its blob's middle lies between four pixels

    found = detect_interest_points(image)

    blobs = found.pixels[found.kind == BLOB]
    near = (blobs - torch.tensor((41.0, 31.0))).norm(dim=-1) < 1.5
    torch.testing.assert_close(blobs[near], torch.tensor([[41.0, 31.0]], dtype=torch.float64), rtol=0.0, atol=0.15)


def test_an_image_that_is_all_border_has_no_points():
    assert len(detect_interest_points(torch.rand(8, 300) * 255.0)) == 0


def test_misuse_is_named():
    image = torch.zeros(40, 50)

    with pytest.raises(ValueError, match=r"image has shape \(1, 40, 50\), but must be \(height, width\)"):
        detect_interest_points(image[None])
    with pytest.raises(ValueError, match="image is nan somewhere, but must be finite"):
        detect_interest_points(image + torch.nan)
    with pytest.raises(ValueError, match="per_cell is 0, but must be finite and at least 1"):
        detect_interest_points(image, per_cell=0)
    with pytest.raises(ValueError, match="cell is 0, but must be finite and at least 1"):
        detect_interest_points(image, cell=0)


def test_kornia_waits_until_it_is_needed():
    code = "import sys, torchrefrac.dense.matching.epipolar_curve; print('kornia' in sys.modules)"

    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)

    assert run.stdout.strip() == "False"


def _bumps(height: int, width: int, centers: Tensor, sizes: Tensor, spread: float) -> Tensor:
    """(height, width): Gaussians of standard deviation `spread` at centers (k, 2), COLMAP's convention."""
    y, x = torch.arange(height).double() + 0.5, torch.arange(width).double() + 0.5
    along_y = torch.exp(-0.5 * ((y - centers[:, 1:]) / spread).square())
    along_x = torch.exp(-0.5 * ((x - centers[:, :1]) / spread).square())
    return (sizes[:, None] * along_y).T @ along_x
