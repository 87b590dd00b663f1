"""Polygons: what lies inside, and which are none."""

import math

import pytest
import torch

from torchrefrac.geometry.polygon import inside_polygon, is_simple

STAR = [(0.0, 0.0), (4.0, 1.0), (8.0, -1.0), (7.0, 4.0), (9.0, 8.0), (4.0, 6.0), (-1.0, 9.0), (1.0, 4.0)]
SQUARE = [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)]


def winding(corners, point):
    """How often a polygon goes round a point: the sum of the angles under which its sides are seen."""
    total = 0.0
    for (ax, ay), (bx, by) in zip(corners, [*corners[1:], corners[0]], strict=True):
        a, b = math.atan2(ay - point[1], ax - point[0]), math.atan2(by - point[1], bx - point[0])
        total += (b - a + math.pi) % (2.0 * math.pi) - math.pi
    return round(total / (2.0 * math.pi))


@pytest.mark.parametrize("corners", [STAR, STAR[::-1], SQUARE], ids=["left", "right", "square"])
def test_inside_is_where_the_polygon_goes_round(draw, corners):
    points = draw.uniform(-2.0, 10.0, 20, 20, 2)

    inside = inside_polygon(points, torch.tensor(corners, dtype=torch.float64))

    expected = [abs(winding(corners, point)) == 1 for point in points.flatten(0, 1).tolist()]
    assert inside.shape == (20, 20)
    assert inside.flatten().tolist() == expected


@pytest.mark.parametrize("corners", [SQUARE, STAR, SQUARE[:3], [*SQUARE[:2], (1.0, 0.5), *SQUARE[2:]]])
def test_polygons_whose_sides_meet_at_corners_alone_are_simple(corners):
    assert is_simple(torch.tensor(corners, dtype=torch.float64))
    assert is_simple(torch.tensor(corners[::-1], dtype=torch.float64))


@pytest.mark.parametrize(
    "corners",
    [
        [SQUARE[0], SQUARE[2], SQUARE[1], SQUARE[3]],
        [*SQUARE, SQUARE[0]],
        [(0.0, 0.0), (1.0, 0.0), (2.0, 0.0)],
        [(0.0, 0.0), (2.0, 0.0), (1.0, 0.0), (1.0, 1.0)],
        [(0.0, 0.0), (4.0, 0.0), (4.0, 4.0), (2.0, 0.0), (0.0, 4.0)],
    ],
    ids=["crossing", "closed twice", "a line", "folded back", "touching"],
)
def test_other_polygons_are_not(corners):
    assert not is_simple(torch.tensor(corners, dtype=torch.float64))
