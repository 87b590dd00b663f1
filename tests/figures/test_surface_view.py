"""Discs about oriented points, against a loop over discs and pixels, and the picture of a surface."""

import cv2
import pytest
import torch

from torchrefrac.figures.splats import LEAST_COSINE, Window, splat
from torchrefrac.figures.surface_view import draw_surface_view
from torchrefrac.scene import DenseCloud
from torchrefrac.scene.wording import OF_WATER, wording

DOUBLE = torch.float64


def splat_slowly(points, normals, values, radius, window):
    """The same, pixel by pixel."""
    found = torch.zeros(window.rows, window.columns, values.shape[-1], dtype=DOUBLE)
    covered = torch.zeros(window.rows, window.columns, dtype=torch.bool)
    for row in range(window.rows):
        for column in range(window.columns):
            x, y = window.left + (column + 0.5) * window.size, window.top - (row + 0.5) * window.size
            hits = []
            for point, normal, value in zip(points, normals, values, strict=True):
                facing = normal if normal[2] >= 0.0 else -normal
                right, up = x - point[0], y - point[1]
                rise = -(facing[0] * right + facing[1] * up) / max(facing[2], LEAST_COSINE)
                weight = 1.0 - (right**2 + up**2 + rise**2) / radius**2
                if weight > 0.0:
                    hits.append((point[2] + rise, weight, value))
            if hits:
                nearest = max(near for near, _, _ in hits)
                shown = [(weight, value) for near, weight, value in hits if near > nearest - radius]
                found[row, column] = sum(w * v for w, v in shown) / sum(w for w, _ in shown)
                covered[row, column] = True
    return found, covered


def test_discs_are_seen_and_hidden_as_a_loop_over_them_and_the_pixels_says(draw):
    points = draw.uniform(-1.0, 1.0, 40, 3)
    normals = torch.nn.functional.normalize(draw.normal(40, 3), dim=-1)
    values = draw.uniform(0.0, 1.0, 40, 2)
    window = Window(-1.05, 0.95, 0.1, 19, 21)

    found, covered = splat(points, normals, values, 0.35, window)

    expected, seen = splat_slowly(points, normals, values, 0.35, window)
    assert 0.5 < float(seen.double().mean()) < 1.0
    assert torch.equal(covered, seen)
    torch.testing.assert_close(found[covered], expected[seen])


def test_nothing_is_seen_of_no_points():
    none = torch.zeros(0, 3, dtype=DOUBLE)

    _, covered = splat(none, none, none, 0.1, Window(0.0, 0.0, 0.1, 4, 5))

    assert not covered.any()


def sheet(height, color, normal, count=60):
    """A level square, its side 2."""
    side = torch.linspace(-1.0, 1.0, count, dtype=DOUBLE)
    points = torch.nn.functional.pad(torch.cartesian_prod(side, side), (0, 1), value=height)
    n = len(points)
    normals = torch.nn.functional.normalize(torch.tensor(normal, dtype=DOUBLE), dim=0).expand(n, 3)
    ones, whole = torch.ones(n, dtype=DOUBLE), torch.zeros(n, dtype=torch.long)
    colors = torch.tensor(color, dtype=torch.uint8).expand(n, 3)
    return DenseCloud(points, normals, colors, ones, ones, whole, whole, ones, "m")


def drawn(cloud, path, words=OF_WATER):
    """The two panels, BGR."""
    draw_surface_view(cloud, None, None, words, path)
    image = cv2.imread(str(path)).astype(int)
    return image[:, : image.shape[1] // 2], image[:, image.shape[1] // 2 :]


def test_what_is_above_hides_what_is_below_and_a_sheet_of_points_has_no_holes(tmp_path):
    red, green = (200, 30, 30), (30, 160, 30)
    cloud = DenseCloud.joined([sheet(-1.0, green, (0.0, 0.0, 1.0)), sheet(0.0, red, (0.0, 0.0, 1.0))])

    colored, _ = drawn(cloud, tmp_path / "view.png")

    is_red, is_green = ((abs(colored - color[::-1]) < 12).all(axis=-1) for color in (red, green))
    assert is_red.sum() > 1.5 * is_green.sum() > 0
    rows = is_red.sum(axis=1)
    middle = is_red[rows.argmax()].nonzero()[0]
    assert len(middle) == middle[-1] - middle[0] + 1


@pytest.mark.parametrize(
    ("kind", "lit", "unlit"),
    [("surface", (-1.0, 1.0, 1.4), (1.0, -1.0, 0.5)), ("wall", (-1.0, 1.4, 1.0), (1.0, -1.0, 0.5))],
)
def test_what_faces_the_light_is_bright_and_what_does_not_is_dark(tmp_path, kind, lit, unlit):
    shades = []
    for normal in (lit, unlit):
        _, clay = drawn(sheet(0.0, (0, 0, 255), normal), tmp_path / "view.png", wording(kind))
        middle = clay[
            clay.shape[0] // 2 - 20 : clay.shape[0] // 2 + 20, clay.shape[1] // 2 - 20 : clay.shape[1] // 2 + 20
        ]
        shades.append(middle.mean())

    bright, dark = shades
    assert bright > 200
    assert dark < 0.45 * bright


@pytest.mark.parametrize("count", [1, 2, 5])
def test_few_points_are_drawn_too(tmp_path, count):
    colored, _ = drawn(sheet(0.0, (0, 0, 255), (0.0, 0.0, 1.0), count), tmp_path / "view.png")

    assert colored.std() > 5
