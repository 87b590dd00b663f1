"""Places on the Z-order curve."""

import pytest
import torch

from tests.tolerances import DTYPES
from torchrefrac.numerics import morton_code


def interleaved(x: int, y: int, z: int) -> int:
    """... z1 y1 x1 z0 y0 x0, written down digit by digit."""
    digits = [f"{value:016b}" for value in (z, y, x)]
    return int("".join(digit for triple in zip(*digits, strict=True) for digit in triple), 2)


def test_the_code_interleaves_the_digits_of_the_cells(generator):
    cells = torch.randint(0, 2**16, (200, 3), generator=generator)
    cells[0], cells[1] = 0, 2**16 - 1  # the bounding cube is all of the grid

    code = morton_code(cells.double() + 0.25 * (cells < 2**16 - 1) * (cells > 0))

    assert code.dtype == torch.long
    assert code.tolist() == [interleaved(*cell) for cell in cells.tolist()]


def test_neighbours_on_the_curve_are_near_each_other(draw):
    points = draw.uniform(-5.0, 40.0, 4000, 3)

    along = points[morton_code(points).argsort()]

    steps = along.diff(dim=0).norm(dim=1)
    at_random = points.diff(dim=0).norm(dim=1)
    assert steps.mean() < 0.15 * at_random.mean()


def test_runs_along_the_curve_are_compact(draw):
    """64 of 4096 points in a unit cube would fill a cube of a quarter of its side."""
    points = draw.uniform(0.0, 1.0, 4096, 3)

    runs = points[morton_code(points).argsort()].view(64, 64, 3)

    extent = runs.amax(dim=1) - runs.amin(dim=1)
    assert extent.median() < 0.4


def test_each_octant_of_the_cube_is_passed_through_once(draw):
    points = torch.cat((draw.uniform(0.0, 1.0, 500, 3), torch.tensor([[0.0] * 3, [1.0] * 3], dtype=torch.float64)))
    half = (points >= 0.5 + 1e-4).long()
    clear = ((points - 0.5).abs() > 1e-4).all(dim=1)

    octant = (half @ torch.tensor([1, 2, 4]))[clear][morton_code(points)[clear].argsort()]

    assert (octant.diff() >= 0).all()


def test_shift_and_scale_hardly_matter(draw):
    points = draw.normal(500, 3)

    moved = morton_code(1024.0 * (points - points.amin(dim=0)))

    assert torch.equal(morton_code(0.5 * (points - points.amin(dim=0))), moved)


def test_points_that_are_no_numbers_get_a_place_and_leave_the_others_theirs(draw):
    points = torch.cat((draw.uniform(-1.0, 1.0, 100, 3), draw.uniform(-1.0, 1.0, 3, 3)))
    spoiled = points.clone()
    spoiled[100, 0], spoiled[101], spoiled[102, 2] = torch.nan, torch.inf, -torch.inf
    points[100:] = torch.where(spoiled[100:].isfinite(), points[100:], 0.0)

    assert torch.equal(morton_code(spoiled), morton_code(points))


@pytest.mark.parametrize("dtype", DTYPES)
def test_points_that_all_coincide_share_a_place(dtype):
    assert morton_code(torch.full((4, 3), 7.5, dtype=dtype)).tolist() == [0, 0, 0, 0]


def test_points_of_a_plane_lie_along_the_curve_of_the_plane(draw):
    points = torch.nn.functional.pad(draw.uniform(0.0, 1.0, 300, 2), (0, 1), value=-3.0)

    code = morton_code(points)

    assert not (code & 0o4444444444444444).any()
    assert len(code.unique()) == 300


def test_no_points_have_no_places():
    code = morton_code(torch.zeros(0, 3))

    assert (code.shape, code.dtype) == ((0,), torch.long)
