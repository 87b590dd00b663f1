"""Two photographs of chessboards through the flat wall of a water tank, in millimetres."""

import json

import pytest
import torch

from torchrefrac.camera import Intrinsics, RefractiveCamera
from torchrefrac.refraction import FlatInterface

HALF_PIXEL = 0.5  # the file counts pixels as OpenCV does: the centre of the first one is (0, 0)


@pytest.fixture
def measured(shared_data):
    return json.loads((shared_data("two_view_photos") / "two_view_points.json").read_text())


def test_corners_triangulate_to_a_millimetre_and_a_half_through_the_water(measured):
    assert _mean_error(measured, measured["n_water"]) <= 1.6


def test_corners_are_off_by_centimetres_where_refraction_is_ignored(measured):
    assert _mean_error(measured, 1.0) > 30.0


def _mean_error(measured, index_ratio):
    """Mean distance between the true corners and the points nearest to their two rays."""
    origins, directions = zip(*(_rays(view, index_ratio) for view in measured["views"]), strict=True)
    origin, direction = torch.stack(origins, dim=1), torch.stack(directions, dim=1)  # (corners, views, 3)
    across = torch.eye(3, dtype=torch.float64) - direction[..., :, None] * direction[..., None, :]
    points = torch.linalg.solve(across.sum(dim=1), (across @ origin[..., None]).sum(dim=1))[..., 0]
    truth = torch.tensor(measured["points"], dtype=torch.float64)
    assert len(truth) == 27
    return (points - truth).norm(dim=-1).mean()


def _rays(view, index_ratio):
    (fx, _, cx), (_, fy, cy), _ = view["K"]
    lens = Intrinsics.create(
        3648, 2736, (fx, fy), (cx + HALF_PIXEL, cy + HALF_PIXEL), (*view["dist_k1k2"], 0.0, 0.0, 0.0)
    )
    rotation, center = (torch.tensor(view[name], dtype=torch.float64) for name in ("R", "c"))
    camera = RefractiveCamera(lens, rotation, center, FlatInterface(index_ratio))
    origins, directions, valid = camera.cast_rays(torch.tensor(view["uv"], dtype=torch.float64) + HALF_PIXEL)
    assert valid.all()
    return origins, directions
