"""Verticals that nobody measured, from the refraction between two views."""

import math
from dataclasses import dataclass
from typing import Any

import pytest
import torch
from torch import Tensor

from torchrefrac.geometry import so3_log
from torchrefrac.sfm.unknown_vertical import MAX_SIGMA_DEG, find_verticals, pinhole_rotation


@dataclass(frozen=True)
class Pair:
    """basin: the truth; plane (2, N, 2) of its points, of which those not `right` (N) are random in image two."""

    basin: Any
    plane: Tensor
    right: Tensor

    def solve(self):
        return find_verticals(*self.plane, self.basin.lens.focal, self.basin.index_ratio)

    def off(self, found) -> Tensor:
        """Angles (2) in radians between the verticals found and the true ones."""
        return torch.linalg.cross(found.down_in_cam, self.basin.down_in_cam).norm(dim=-1).asin()


@pytest.fixture
def make_pair(make_basin, draw):
    """`make_pair(points=500, outliers=150, noise=0.3, index_ratio=1.33)`."""

    def make(points=500, outliers=150, noise=0.3, index_ratio=1.33):
        basin = make_basin(points=points, index_ratio=index_ratio)
        pixels = basin.project()[0] + noise * draw.normal(2, points, 2)
        pixels[1, :outliers] = draw.uniform(0.0, 1.0, outliers, 2) * pixels.new_tensor((1024.0, 768.0))
        return Pair(basin, basin.lens.plane_from_pixels(pixels), torch.arange(points) >= outliers)

    return make


@pytest.mark.parametrize("draws", [10, pytest.param(40, marks=pytest.mark.slow)])
def test_verticals_are_found_within_a_degree_and_as_well_as_their_sigma_says(make_pair, draws):
    near, normalised = [], []
    for _ in range(draws):
        pair = make_pair(points=1000, outliers=300)
        found = pair.solve()
        assert found.status == "success"
        off = pair.off(found)
        near.append(bool((off < math.radians(1.0)).all()))
        normalised.append(off / found.sigma)
    assert sum(near) >= 0.9 * draws
    assert 0.6 < float(torch.stack(normalised).square().mean().sqrt()) < 1.5


def test_the_pose_comes_with_the_verticals(make_pair):
    pair = make_pair()
    found = pair.solve()

    _, center = pair.basin.second_from_first()
    height = pair.basin.center[0, 2]
    torch.testing.assert_close(found.center[0], found.center.new_tensor((0.0, 0.0, 1.0)))
    torch.testing.assert_close(found.center[1] * height, center, rtol=0.0, atol=0.5)
    turned = pair.basin.rotation[1] @ pair.basin.rotation[0].mT
    assert so3_log(found.rotation[1] @ found.rotation[0].mT @ turned.mT).norm() < math.radians(0.3)
    torch.testing.assert_close(-found.rotation[..., 2], found.down_in_cam)
    assert (found.inliers & pair.right).sum() >= 0.99 * pair.right.sum()
    assert (found.inliers & ~pair.right).sum() <= 0.1 * (~pair.right).sum()


def test_clean_matches_give_the_verticals_exactly(make_pair):
    pair = make_pair(outliers=0, noise=0.0)
    assert pair.off(pair.solve()).amax() < 1e-6


def test_the_same_matches_give_the_same_bits(make_pair):
    pair = make_pair()
    assert torch.equal(pair.solve().rotation, pair.solve().rotation)


def test_a_pinhole_gets_the_relative_rotation_wrong_by_far_more_than_the_search_it_starts(make_pair):
    pair = make_pair(outliers=0)
    rotation, inliers = pinhole_rotation(*pair.plane, 4.0 / 667.0)
    found = pair.solve()

    turned = pair.basin.rotation[1] @ pair.basin.rotation[0].mT
    off = so3_log(rotation @ turned.mT).norm()
    assert math.radians(0.5) < off < math.radians(15.0)
    assert so3_log(found.rotation[1] @ found.rotation[0].mT @ turned.mT).norm() < 0.2 * off
    assert inliers.sum() < found.inliers.sum() == 500


def test_refraction_that_is_too_weak_is_degenerate_and_says_how_uncertain(make_pair):
    for _ in range(3):
        found = make_pair(index_ratio=1.005).solve()
        assert found.status == "degenerate"
        assert float(found.sigma.amax()) > math.radians(MAX_SIGMA_DEG)
        assert "refraction is too weak" in found.detail


@pytest.mark.parametrize("points", [8, 200, 1000])
def test_random_matches_have_no_consensus(make_pair, points):
    found = make_pair(points=points, outliers=points).solve()
    assert found.status == "no_consensus"
    assert found.sigma.isinf().all()
    assert not found.inliers.any()


def test_without_refraction_the_question_is_refused(make_pair):
    pair = make_pair(points=50, outliers=0)
    with pytest.raises(ValueError, match="index_ratio is 1, but must be finite and above 1"):
        find_verticals(*pair.plane, pair.basin.lens.focal, 1.0)
