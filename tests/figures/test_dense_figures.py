"""Figures of dense reconstructions: colours mean what they should, and anything can be drawn."""

import cv2
import numpy as np
import pytest
import torch

from torchrefrac.evaluate.dense_metrics import evaluate_dense
from torchrefrac.figures import dense as dense_figures
from torchrefrac.figures.dense import draw_dense_views, draw_depth_map, draw_error_map, error_panel
from torchrefrac.figures.panels import EMPTY, Column, from_side, oblique
from torchrefrac.figures.plotting import height_colors
from torchrefrac.figures.side_views import SideView
from torchrefrac.files.library import embedded_scene
from torchrefrac.files.truth import load_truth
from torchrefrac.geometry import Similarity, heading_rotation
from torchrefrac.scene.dense import DenseCloud, DepthMap

DOUBLE = torch.float64
IDENTITY = Similarity(torch.ones((), dtype=DOUBLE), torch.eye(3, dtype=DOUBLE), torch.zeros(3, dtype=DOUBLE))


@pytest.fixture(scope="module")
def truth():
    return load_truth(embedded_scene("tank_small"))


def _cloud(points):
    count, vectors = len(points), torch.zeros_like(points)
    ones, whole = torch.ones(count, dtype=DOUBLE), torch.zeros(count, dtype=torch.long)
    return DenseCloud(points, vectors, vectors.to(torch.uint8), ones, ones, whole, whole, ones, "cm")


def _sheet(truth, height, count=100):
    """Points (count^2, 3) in a grid over the whole bottom, all `height` above it."""
    s = torch.linspace(0.0, 1.0, count, dtype=DOUBLE)
    grid = torch.cartesian_prod(s, s)
    points = truth.corner[0] + grid[:, :1] * truth.edge1[0] + grid[:, 1:] * truth.edge2[0]
    return points + torch.tensor((0.0, 0.0, height), dtype=DOUBLE)


def _colors(path, part=slice(None)):
    """Shares of clearly red, clearly blue and pale yellow pixels in the columns `part` of the upper half of a PNG."""
    image = cv2.imread(str(path)).astype(int)
    blue, green, red = np.moveaxis(image[: len(image) // 2, part], -1, 0)
    yellow = (red > 240) & (green > 240) & (blue > 150) & (blue < 210)
    return (red > blue + 90).mean(), (blue > red + 90).mean(), yellow.mean()


@pytest.mark.parametrize(("error", "which"), [(-0.2, 0), (0.2, 1), (0.0, 2)])
def test_too_low_is_red_too_high_is_blue_and_right_is_pale(truth, tmp_path, error, which):
    points = _sheet(truth, error)
    panel = Column("Refraction", "", points, torch.full((len(points),), error, dtype=DOUBLE), "cm")

    draw_error_map([panel], truth, tmp_path / "error.png", limit=0.2)

    shares = _colors(tmp_path / "error.png", slice(0, 700))
    assert shares[which] > 0.3
    assert all(share < 0.02 for index, share in enumerate(shares) if index != which)


def test_the_upper_surface_hides_the_lower_one_from_above(truth, tmp_path):
    points = torch.cat((_sheet(truth, 40.0), _sheet(truth, 0.0)))
    error = torch.tensor((0.2, -0.2), dtype=DOUBLE).repeat_interleave(len(points) // 2)

    draw_error_map([Column("Refraction", "", points, error, "cm")], truth, tmp_path / "error.png", limit=0.2)

    red, blue, _ = _colors(tmp_path / "error.png", slice(0, 700))
    assert blue > 0.3
    assert red < 0.01


def test_on_one_surface_neither_the_high_nor_the_low_points_win(truth, tmp_path, draw):
    error = 0.05 * torch.sign(draw.normal(150_000))
    points = _sheet(truth, 0.0, 400)[: len(error)]
    points = points + torch.tensor((0.0, 0.0, 1.0), dtype=DOUBLE) * error[:, None]

    draw_error_map([Column("Refraction", "", points, error, "cm")], truth, tmp_path / "error.png", limit=0.05)

    red, blue, _ = _colors(tmp_path / "error.png", slice(0, 700))
    assert red == pytest.approx(blue, rel=0.2)
    assert red > 0.15


@pytest.mark.parametrize("order", [1, -1])
def test_without_a_limit_the_panel_with_the_smallest_errors_gives_the_scale(truth, tmp_path, draw, order):
    points, noise = _sheet(truth, 0.0), draw.normal(10_000)
    panels = [Column(f"{size}", "", points, size * noise, "cm") for size in (0.04, 7.0)][::order]

    draw_error_map(panels, truth, tmp_path / "own.png")
    draw_error_map(panels, truth, tmp_path / "given.png", limit=0.2)

    assert np.array_equal(cv2.imread(str(tmp_path / "own.png")), cv2.imread(str(tmp_path / "given.png")))


def test_the_panel_of_a_cloud_says_how_accurate_it_is(truth):
    turned = Similarity(
        torch.tensor(2.0, dtype=DOUBLE), heading_rotation(torch.tensor(0.4, dtype=DOUBLE)), torch.zeros(3, dtype=DOUBLE)
    )
    points = torch.cat((_sheet(truth, 0.15, 10), _sheet(truth, 0.3, 10)))
    cloud = _cloud(points @ turned.rotation / 2.0)

    panel = error_panel("refractive", cloud, turned, truth, evaluate_dense(cloud, truth, turned, None))

    assert panel.title == "Refraction"
    assert panel.caption.splitlines() == [
        "200 points",
        "0.0 / 50.0 / 100.0 % within 0.1 / 0.2 / 0.5 cm",
        "RMS 0.237 cm",
    ]
    torch.testing.assert_close(panel.points, points)
    torch.testing.assert_close(panel.values, torch.tensor((0.15, 0.3), dtype=DOUBLE).repeat_interleave(100))


def test_no_more_points_are_drawn_than_can_be_seen(truth, monkeypatch):
    monkeypatch.setattr(dense_figures, "MOST", 64)

    panel = error_panel("none", _cloud(_sheet(truth, 0.0, 10)), IDENTITY, truth, {})

    assert panel.caption == "100 points"
    assert len(panel.points) == len(panel.values) == 50


@pytest.mark.parametrize("with_truth", [True, False])
@pytest.mark.parametrize("count", [0, 1, 500])
def test_dense_views_are_drawn_for_any_number_of_points(truth, tmp_path, draw, with_truth, count):
    points = draw.uniform(-100.0, 0.0, count, 3)
    view = SideView("Refraction", f"{count} points", points, draw.uniform(10.0, 20.0, count, 3), "cm", True)

    draw_dense_views([view, view], truth if with_truth else None, tmp_path / "views.png")

    image = cv2.imread(str(tmp_path / "views.png"))
    assert 600 < image.shape[0] < 6000
    assert 1000 < image.shape[1] < 2000
    assert image.std() > 5


def test_the_lowest_points_are_dark_and_the_highest_light(tmp_path, draw):
    flat = draw.uniform(-50.0, 50.0, 5000, 2)
    views = []
    for low, high in ((-10.0, -9.0), (-1.0, 0.0)):
        points = torch.cat((flat, draw.uniform(low, high, 5000, 1)), dim=-1)
        views.append(SideView("", "", points, torch.zeros(0, 3, dtype=DOUBLE), "m", False))

    draw_dense_views(views, None, tmp_path / "views.png")

    for part, (own, other) in ((slice(0, 700), (0, 1)), (slice(750, 1350), (1, 0))):
        picture = cv2.imread(str(tmp_path / "views.png"))[:, part, ::-1].astype(float) / 255.0
        near = [(np.abs(picture - height_colors()(end)[:3]).max(axis=-1) < 0.15).mean() for end in (0.0, 1.0)]
        assert near[own] > 0.1
        assert near[other] < 0.01


@pytest.mark.parametrize("with_truth", [True, False])
def test_an_oblique_view_looks_from_above_with_the_vertical_upright(truth, with_truth):
    side = from_side(truth if with_truth else None)
    turned = oblique(side)

    for frame in (side, turned):
        torch.testing.assert_close(frame @ frame.T, torch.eye(3, dtype=DOUBLE))
        assert float(torch.linalg.det(frame)) == pytest.approx(1.0)
    up = turned @ torch.tensor((0.0, 0.0, 1.0), dtype=DOUBLE)
    assert float(up[0]) == pytest.approx(0.0)
    assert up[1] > 0.5
    assert up[2] > 0.2


@pytest.mark.parametrize("share", [0.0, 0.7, 1.0])
def test_a_depth_map_is_drawn_whatever_it_holds(tmp_path, draw, share):
    valid = draw.uniform(0.0, 1.0, 48, 64) < share
    depth = torch.where(valid, draw.uniform(50.0, 90.0, 48, 64), 0.0)
    points = torch.stack((depth, depth, -depth), dim=-1)

    draw_depth_map(DepthMap("a.png", 4, points, depth, 0.01 * depth, valid, "cm"), tmp_path / "depth.png")

    image = cv2.imread(str(tmp_path / "depth.png"))
    assert image.shape[1] > image.shape[0] > 300
    middle = image[200:-200, 150:650]
    neutral = (middle == int(EMPTY[1:3], 16)).all(axis=-1).mean()
    assert neutral == pytest.approx(1.0 - share, abs=0.1)


def test_an_empty_cloud_has_an_error_map(truth, tmp_path):
    panel = error_panel("none", DenseCloud.empty("cm"), IDENTITY, truth, {})

    draw_error_map([panel], truth, tmp_path / "error.png")

    assert (tmp_path / "error.png").is_file()
    assert panel.caption == "0 points"
