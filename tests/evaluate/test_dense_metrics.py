"""Dense metrics on errors that were planted, and against distances by brute force."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from torchrefrac.evaluate.dense_metrics import evaluate_dense, signed_plane_distance
from torchrefrac.evaluate.textured import textured_points
from torchrefrac.files.truth import load_truth, load_truth_points
from torchrefrac.geometry import Similarity, so3_exp
from torchrefrac.geometry.surfaces import Rectangle
from torchrefrac.geometry.triangle_mesh import TriangleMesh
from torchrefrac.scene import Truth
from torchrefrac.scene.dense import DenseCloud
from torchrefrac.scene.truth import TruthPoints

DOUBLE = torch.float64
IDENTITY = Similarity(torch.ones((), dtype=DOUBLE), torch.eye(3, dtype=DOUBLE), torch.zeros(3, dtype=DOUBLE))


@pytest.fixture
def truth():
    """A floor of 100 x 100 at z = -10, its normal down as it stands, and a roof of 20 x 20 at 45 degrees above it."""

    def table(*rows):
        return torch.tensor(rows, dtype=DOUBLE)

    return Truth(
        names=(),
        rotation=torch.zeros(0, 3, 3, dtype=DOUBLE),
        center=torch.zeros(0, 3, dtype=DOUBLE),
        corner=table((-50.0, -50.0, -10.0), (0.0, 0.0, 10.0)),
        edge1=table((0.0, 100.0, 0.0), (20.0, 0.0, 20.0)),
        edge2=table((100.0, 0.0, 0.0), (0.0, 20.0, 0.0)),
        length_unit="cm",
    )


def _cloud(points, sigma=1.0):
    count, vectors = len(points), torch.zeros_like(points)
    sigma = torch.as_tensor(sigma, dtype=DOUBLE).expand(count)
    whole = torch.zeros(count, dtype=torch.long)
    return DenseCloud(points, vectors, vectors.to(torch.uint8), sigma, sigma, whole, whole, sigma, "cm")


def _floor(draw, errors):
    """Points over the floor, off it by `errors` (n)."""
    return torch.cat((draw.uniform(-40.0, -5.0, len(errors), 2), errors[:, None] - 10.0), dim=-1)


def test_points_above_a_plane_are_positive_whichever_way_its_edges_turn(truth):
    points = torch.tensor([[10.0, 10.0, -9.0], [10.0, 10.0, -13.0], [10.0, 5.0, 21.0], [10.0, 5.0, 18.0]], dtype=DOUBLE)

    signed, plane = signed_plane_distance(points, truth)

    assert plane.tolist() == [0, 0, 1, 1]
    assert signed.tolist() == pytest.approx([1.0, -3.0, 0.5**0.5, -2.0 * 0.5**0.5])


def test_the_nearest_rectangle_is_that_of_a_brute_force_search(truth, draw):
    points = torch.cat((draw.uniform(-60.0, 60.0, 200, 2), draw.uniform(-20.0, 40.0, 200, 1)), dim=-1)
    steps = torch.cartesian_prod(*(torch.linspace(0.0, 1.0, 201, dtype=DOUBLE),) * 2)

    signed, plane = signed_plane_distance(points, truth)

    surface = truth.corner[:, None] + steps[:, :1] * truth.edge1[:, None] + steps[:, 1:] * truth.edge2[:, None]
    gap = torch.stack([torch.cdist(points, samples).amin(dim=-1) for samples in surface], dim=-1)
    clear = (gap[:, 0] - gap[:, 1]).abs() > 1.0
    assert clear.sum() > 150
    assert torch.equal(plane[clear], gap.argmin(dim=-1)[clear])
    height = torch.stack((points[:, 2] + 10.0, (points[:, 2] - 10.0 - points[:, 0]) * 0.5**0.5), dim=-1)
    torch.testing.assert_close(signed, height.gather(1, plane[:, None])[:, 0])


def test_a_vertical_plane_keeps_its_own_normal(truth):
    wall = replace(truth, edge1=torch.tensor([[0.0, 0.0, 5.0], [0.0, 1.0, 0.0]], dtype=DOUBLE))

    signed, _ = signed_plane_distance(torch.tensor([[0.0, -47.0, -8.0]], dtype=DOUBLE), wall)

    assert signed.tolist() == [3.0]


def test_a_truth_without_planes_has_no_signed_distance(truth):
    none = replace(truth, corner=truth.corner[:0], edge1=truth.edge1[:0], edge2=truth.edge2[:0])

    with pytest.raises(ValueError, match="truth has no planes"):
        signed_plane_distance(torch.zeros(1, 3, dtype=DOUBLE), none)


def test_accuracy_is_the_share_of_points_below_each_threshold(truth, draw):
    errors = torch.tensor((0.05, -0.05, 0.15, -0.3, 0.6, 0.0, -0.19, 0.4), dtype=DOUBLE)

    found = evaluate_dense(_cloud(_floor(draw, errors)), truth, IDENTITY, None)

    assert found["dense_accuracy_within_0.1_cm"] == 3 / 8
    assert found["dense_accuracy_within_0.2_cm"] == 5 / 8
    assert found["dense_accuracy_within_0.5_cm"] == 7 / 8
    assert found["dense_surface_median_cm"] == pytest.approx(0.17)
    assert found["dense_surface_p95_cm"] == pytest.approx(np.quantile(errors.abs().numpy(), 0.95))
    assert not any("completeness" in key for key in found)


def test_a_point_beyond_the_border_is_inaccurate_though_in_the_plane(truth):
    points = torch.tensor([[-53.0, 0.0, -10.0], [-40.0, 0.0, -10.0]], dtype=DOUBLE)

    found = evaluate_dense(_cloud(points), truth, IDENTITY, None, within=(1.0, 4.0))

    assert found["dense_accuracy_within_1_cm"] == 0.5
    assert found["dense_accuracy_within_4_cm"] == 1.0
    assert found["dense_plane_rms_cm"] == pytest.approx(0.0, abs=1e-12)


def test_completeness_is_that_of_a_brute_force_search(truth, draw):
    points, seen = draw.uniform(0.0, 2.0, 300, 3), draw.uniform(0.0, 2.0, 1000, 3)

    found = evaluate_dense(_cloud(points), truth, IDENTITY, seen, within=(0.05, 0.1, 0.3))

    gap = torch.cdist(seen, points).amin(dim=-1)
    for threshold in (0.05, 0.1, 0.3):
        share = float((gap < threshold).double().mean())
        assert 0.0 < share < 1.0
        assert found[f"dense_completeness_within_{threshold}_cm"] == pytest.approx(share)


def test_the_alignment_moves_points_and_scales_sigma(truth, draw):
    errors, seen = 0.1 * draw.normal(500), _floor(draw, torch.zeros(200, dtype=DOUBLE))
    points = _floor(draw, errors)
    turned = so3_exp(torch.tensor((0.3, -0.2, 1.0), dtype=DOUBLE))
    alignment = Similarity(torch.tensor(2.5, dtype=DOUBLE), turned, torch.tensor((1.0, 2.0, 3.0), dtype=DOUBLE))
    own = (points - alignment.translation) @ turned / 2.5

    expected = evaluate_dense(_cloud(points, 0.1), truth, IDENTITY, seen, within=(0.1, 0.5))
    found = evaluate_dense(_cloud(own, 0.1 / 2.5), truth, alignment, seen, within=(0.1, 0.5))

    assert 0.0 < expected["dense_completeness_within_0.5_cm"] < 1.0
    for key, value in expected.items():
        assert found[key] == pytest.approx(value), key


def test_outliers_of_the_clouds_own_errors_take_no_part_in_the_rms(truth, draw):
    errors = 0.05 * draw.normal(4000)
    errors[:40] = 3.0

    found = evaluate_dense(_cloud(_floor(draw, errors), 0.05), truth, IDENTITY, None)

    size = errors.numpy()
    kept = size[np.abs(size) <= 3.0 * 1.4826 * np.median(np.abs(size))]
    assert found["dense_plane_inliers"] == pytest.approx(len(kept) / 4000)
    assert found["dense_plane_rms_cm"] == pytest.approx(np.sqrt(np.mean(kept**2)))
    assert found["dense_plane_rms_cm"] == pytest.approx(0.05, rel=0.05)
    assert found["dense_error_over_sigma"] == pytest.approx(float((errors / 0.05).square().mean().sqrt()), rel=0.05)


def test_each_plane_has_its_own_rms(truth, draw):
    low = _floor(draw, torch.full((100,), 0.1, dtype=DOUBLE))
    across = draw.uniform(2.0, 18.0, 50, 2)
    high = torch.stack((across[:, 0], across[:, 1], across[:, 0] + 10.0 - 0.2 * 2.0**0.5), dim=-1)

    both = evaluate_dense(_cloud(torch.cat((low, high))), truth, IDENTITY, None)
    floor = evaluate_dense(_cloud(low), truth, IDENTITY, None)

    assert both["dense_plane_rms_each_cm"] == pytest.approx([0.1, 0.2])
    assert floor["dense_plane_rms_each_cm"] == [pytest.approx(0.1), None]
    assert json.loads(json.dumps(floor)) == floor


def test_beside_a_mesh_its_parts_count_and_planes_only_by_what_is_nearest_to_them(truth, draw):
    """A box between floor and roof: points on its lid are exact, and those off the floor alone are of the plane."""
    lid = Rectangle(*torch.tensor([[-40.0, 10.0, -7.0], [30.0, 0.0, 0.0], [0.0, 30.0, 0.0]], dtype=DOUBLE))
    surfaces = [*map(Rectangle, truth.corner, truth.edge1, truth.edge2), lid]
    vertices, faces = zip(*(surface.triangles() for surface in surfaces), strict=True)
    shifted = [4 * index + face for index, face in enumerate(faces)]
    whole = replace(truth, surface=TriangleMesh(torch.cat(vertices), torch.cat(shifted)))
    on_floor = _floor(draw, torch.full((100,), 0.3, dtype=DOUBLE))
    on_lid = torch.cat((draw.uniform(12.0, 38.0, 200, 2) * torch.tensor((-1.0, 1.0)), torch.full((200, 1), -7.0)), -1)
    cloud = _cloud(torch.cat((on_floor, on_lid.double())))

    found = evaluate_dense(cloud, whole, IDENTITY, None)
    without = evaluate_dense(
        cloud, replace(whole, corner=truth.corner[:0], edge1=truth.edge1[:0], edge2=truth.edge2[:0]), IDENTITY, None
    )

    assert found["dense_accuracy_within_0.1_cm"] == pytest.approx(2 / 3)
    assert found["dense_surface_p95_cm"] == pytest.approx(0.3)
    assert found["dense_plane_rms_cm"] == pytest.approx(0.3)
    assert found["dense_plane_inliers"] == 1.0
    assert evaluate_dense(cloud, truth, IDENTITY, None)["dense_surface_p95_cm"] == pytest.approx(3.0)
    assert {key: found[key] for key in without} == without
    assert not any("plane" in key for key in without)


def test_points_without_a_sigma_say_nothing_of_its_honesty(truth, draw):
    sigma = torch.tensor((0.05, 0.0), dtype=DOUBLE).repeat(50)
    points = _floor(draw, torch.full((100,), 0.1, dtype=DOUBLE))

    assert evaluate_dense(_cloud(points, sigma), truth, IDENTITY, None)["dense_error_over_sigma"] == pytest.approx(2.0)
    assert "dense_error_over_sigma" not in evaluate_dense(_cloud(points, 0.0), truth, IDENTITY, None)


def test_an_empty_cloud_covers_nothing_and_has_no_accuracy(truth):
    seen = torch.zeros(5, 3, dtype=DOUBLE)

    found = evaluate_dense(DenseCloud.empty("cm"), truth, IDENTITY, seen)

    assert found == {f"dense_completeness_within_{t}_cm": 0.0 for t in (0.1, 0.2, 0.5)}


@pytest.fixture
def views(draw):
    """Four images of 40 x 60 pixels, with a point every 4th: the floor in two of them, shifted by a third of a cell,
    its right half hidden by a board in a third one, and another place in the last. Entries lie 1 apart.
    """
    rows, columns = torch.meshgrid(torch.arange(10.0), torch.arange(15.0), indexing="ij")
    floor = torch.stack((columns, rows, torch.zeros_like(rows)), dim=-1).double()
    board = floor.clone()
    board[:, 8:] += torch.tensor((0.0, 0.0, 6.0), dtype=DOUBLE)
    shift = torch.tensor((0.3, 0.3, 0.0), dtype=DOUBLE)
    points = torch.stack((floor, floor + shift, board - shift, floor + 100.0))
    valid = torch.ones(4, 10, 15, dtype=torch.bool)
    valid[0, 0, 0] = valid[1, 4, 5] = False
    points = torch.where(valid[..., None], points, 0.0)
    table = TruthPoints(("a", "b", "c", "d"), 4, 2.0, points, torch.zeros(4, 10, 15, dtype=torch.long), valid)
    return table, [draw.uniform(0.0, 255.0, 40, 60) for _ in range(4)]


def _views_by_brute_force(table, own):
    """Of the valid points of image `own`, by how many images they are seen. Entries of these tables lie 1 apart."""
    points = table.points[own][table.valid[own]]
    count = torch.ones(len(points), dtype=torch.long)
    for other in range(len(table.names)):
        if other != own:
            entries = table.points[other][table.valid[other]]
            count += torch.cdist(points, entries).amin(dim=-1) < 1.5
    return points, count


@pytest.mark.parametrize("min_views", [1, 2, 3, 4])
def test_points_count_where_enough_images_have_an_entry_near_them(views, min_views):
    table, images = views

    found = textured_points(table, images, min_views=min_views)

    every = [_views_by_brute_force(table, own) for own in range(4)]
    expected = torch.cat([points[count >= min_views] for points, count in every])
    assert torch.equal(found, expected)
    assert len(expected) == 0 if min_views == 4 else 100 < len(expected) < 600


def test_a_point_that_a_board_hides_is_not_seen_there(views):
    table, images = views

    found = textured_points(table, images, min_views=3)

    assert (found[:, 2] == 0.0).all()
    assert found[:, 0].max() < 9.0


def test_reach_follows_the_spacing_of_the_entries_there(views):
    table, images = views
    pair = TruthPoints(("a", "b"), 4, 2.0, table.points[:2].clone(), table.plane[:2], torch.ones_like(table.valid[:2]))
    pair.points[0] = 0.0
    pair.points[0, ..., 2] = torch.arange(150.0).view(10, 15) * 100.0
    stretch = torch.tensor((3.0, 1.0, 1.0), dtype=DOUBLE)
    pair.points[1] = stretch * table.points[3] - 100.0
    pair.points[0, 0, 0] = pair.points[1, 5, 5] + torch.tensor((0.0, 0.0, 4.4), dtype=DOUBLE)
    pair.points[0, 0, 1] = pair.points[1, 6, 6] + torch.tensor((0.0, 0.0, 4.6), dtype=DOUBLE)

    found = textured_points(pair, images[:2], min_views=2)

    own = found[(found[:, None] == pair.points[0].flatten(0, 1)).all(dim=-1).any(dim=-1)]
    assert own.tolist() == [pair.points[0, 0, 0].tolist()]


@pytest.mark.parametrize("window", [1, 5, 11])
def test_texture_is_the_spread_of_grey_in_the_window(views, window):
    table, images = views
    images = [image * torch.linspace(0.0, 1.0 / 74.0, 60) + 100.0 for image in images]  # spread 0 to 1

    found = textured_points(table, images, min_views=1, min_contrast=0.5, window=window)

    half, expected = window // 2, []
    for own in range(4):
        grey = images[own].numpy()
        for row, column in table.valid[own].nonzero().tolist():
            y, x = 4 * row + 2, 4 * column + 2
            around = grey[max(y - half, 0) : y + half + 1, max(x - half, 0) : x + half + 1]
            if around.std() >= 0.5:
                expected.append(table.points[own, row, column])
    assert len(found) == len(expected)
    if window > 1:
        assert 50 < len(expected) < int(table.valid.sum())
        assert torch.equal(found, torch.stack(expected))


def test_no_images_see_no_points(views):
    table, _ = views
    none = TruthPoints((), 4, 2.0, table.points[:0], table.plane[:0], table.valid[:0])

    assert textured_points(none, []).shape == (0, 3)


def test_images_may_hold_whole_numbers(views):
    table, images = views
    bytes_of = [image.round().to(torch.uint8) for image in images]

    assert torch.equal(textured_points(table, bytes_of), textured_points(table, [image.double() for image in bytes_of]))


def test_images_that_are_not_those_of_the_points_are_refused(views):
    table, images = views

    with pytest.raises(ValueError, match="images are 3, but truth_points is of 4 images"):
        textured_points(table, images[:3])
    with pytest.raises(ValueError, match="image is 58 x 40 pixels, but the true points need at least 59 x 39"):
        textured_points(table, [image[:, :58] for image in images])
    with pytest.raises(ValueError, match="window is 10, but must be odd"):
        textured_points(table, images, window=10)


def test_most_of_the_tank_is_textured_and_seen_by_three(shared_data):
    folder = shared_data("tank")
    truth = load_truth(folder)
    table = load_truth_points(folder, truth.names)
    images = [torch.from_numpy(cv2.imread(str(folder / "images" / name), cv2.IMREAD_GRAYSCALE)) for name in truth.names]

    found = textured_points(table, images)

    assert 0.7 < len(found) / int(table.valid.sum()) < 0.9
    metrics = evaluate_dense(_cloud(found), truth, IDENTITY, found[::7])
    assert metrics["dense_accuracy_within_0.1_cm"] == 1.0
    assert metrics["dense_completeness_within_0.1_cm"] == 1.0
    assert metrics["dense_plane_rms_cm"] < 1e-4
