"""Alignment of corresponding points."""

import math

import pytest
import torch

from tests.tolerances import assert_matches
from torchrefrac.geometry import (
    Similarity,
    align_above_plane,
    align_similarity,
    are_on_a_line,
    heading_rotation,
    robust_level_similarity,
    robust_similarity,
    so3_exp,
)


def test_similarity_recovers_a_planted_transform(draw):
    source, planted = draw.normal(20, 3), _planted(draw, draw.rotations(), draw.normal(3))

    _assert_same(align_similarity(source, planted.apply(source)), planted)


def test_similarity_recovers_a_planted_transform_from_points_in_a_plane(draw):
    source, planted = draw.normal(20, 3), _planted(draw, draw.rotations(), draw.normal(3))
    source[:, 2] = 0.0

    _assert_same(align_similarity(source, planted.apply(source)), planted)


def test_similarity_never_mirrors(draw):
    source = draw.normal(20, 3)

    found = align_similarity(source, source * torch.tensor([1.0, 1.0, -1.0], dtype=torch.float64))

    assert_matches(torch.linalg.det(found.rotation), torch.tensor(1.0, dtype=torch.float64))


def test_above_plane_recovers_a_planted_transform(draw):
    source, planted = draw.normal(20, 3), _planted_above_plane(draw)

    _assert_same(align_above_plane(source, planted.apply(source)), planted)


def test_above_plane_recovers_heading_and_scale_from_points_on_the_plane(draw):
    source, planted = draw.normal(20, 3), _planted_above_plane(draw)
    source[:, 2] = 0.0

    _assert_same(align_above_plane(source, planted.apply(source)), planted)


def test_above_plane_never_moves_the_water_plane(draw):
    found = align_above_plane(draw.normal(20, 3), draw.normal(20, 3))

    on_plane = draw.normal(50, 3) * torch.tensor([1.0, 1.0, 0.0], dtype=torch.float64)
    assert torch.equal(found.apply(on_plane)[:, 2], torch.zeros(50, dtype=torch.float64))


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("size", [1e-1, 1e-3])
def test_no_perturbation_of_the_similarity_fits_noisy_points_better(draw, size, mirrored):
    source = draw.normal(30, 3)
    target = _planted(draw, draw.rotations(), draw.normal(3)).apply(source) + 0.1 * draw.normal(30, 3)
    source = -source if mirrored else source
    found = align_similarity(source, target)

    for turn, shift, stretch in zip(draw.normal(200, 3), draw.normal(200, 3), draw.normal(200), strict=True):
        other = Similarity(
            found.scale * (size * stretch).exp(),
            so3_exp(size * turn) @ found.rotation,
            found.translation + size * shift,
        )
        assert _misfit(found, source, target) < _misfit(other, source, target)


@pytest.mark.parametrize("size", [1e-1, 1e-3])
def test_no_perturbation_within_its_four_freedoms_fits_noisy_points_better(draw, size):
    source = draw.normal(30, 3)
    target = _planted_above_plane(draw).apply(source) + 0.1 * draw.normal(30, 3)
    found = align_above_plane(source, target)

    for turn, shift, stretch in zip(draw.normal(200), draw.normal(200, 2), draw.normal(200), strict=True):
        other = Similarity(
            found.scale * (size * stretch).exp(),
            heading_rotation(size * turn) @ found.rotation,
            found.translation + size * torch.cat((shift, shift.new_zeros(1))),
        )
        assert _misfit(found, source, target) < _misfit(other, source, target)


def test_cameras_move_with_the_points_that_they_see(draw):
    planted = _planted(draw, draw.rotations(), draw.normal(3))
    cam_from_a, center, point = draw.rotations(5), draw.normal(5, 3), draw.normal(5, 3)

    cam_from_b = planted.apply_to_rotation(cam_from_a)

    in_cam = (cam_from_a @ (point - center)[..., None])[..., 0]
    moved_in_cam = (cam_from_b @ (planted.apply(point) - planted.apply(center))[..., None])[..., 0]
    assert_matches(moved_in_cam, planted.scale * in_cam)


def _planted(draw, rotation, translation):
    return Similarity(draw.power_of_ten(-1.0, 1.0), rotation, translation)


def _planted_above_plane(draw):
    shift = draw.normal(3) * torch.tensor([1.0, 1.0, 0.0], dtype=torch.float64)
    return _planted(draw, heading_rotation(draw.uniform(-math.pi, math.pi)), shift)


def _assert_same(found, planted):
    assert_matches(found.scale, planted.scale)
    assert_matches(found.rotation, planted.rotation)
    torch.testing.assert_close(found.translation, planted.translation, rtol=0.0, atol=1e-12)


def _misfit(transform, source, target):
    return (transform.apply(source) - target).square().sum()


@pytest.mark.parametrize("count", [9, 40])
def test_a_robust_similarity_leaves_out_what_is_wrong(draw, count):
    source, planted = draw.normal(count, 3), _planted(draw, draw.rotations(), draw.normal(3))
    target = planted.apply(source)
    wrong = torch.arange(count) < count // 3
    target[wrong] += 5.0 * draw.directions(int(wrong.sum()))

    found, accepted = robust_similarity(source, target, torch.full((count,), 1e-3).double())

    _assert_same(found, planted)
    assert torch.equal(accepted, ~wrong)


@pytest.mark.parametrize("count", [3, 4, 9])
def test_a_robust_level_similarity_leaves_out_what_is_wrong_and_the_vertical_alone(draw, count):
    source, planted = draw.normal(count, 3), _planted_above_plane(draw)
    planted = Similarity(planted.scale, planted.rotation, planted.translation + torch.tensor((0.0, 0.0, 7.0)))
    target = planted.apply(source)
    wrong = torch.arange(count) < count // 4
    target[wrong, 0] += 5.0

    found, accepted = robust_level_similarity(source, target, torch.full((count,), 1e-3).double())

    _assert_same(found, planted)
    assert torch.equal(accepted, ~wrong)


def test_points_that_weigh_nothing_do_not_count(draw):
    source, planted = draw.normal(9, 3), _planted(draw, draw.rotations(), draw.normal(3))
    target, weight = planted.apply(source), draw.uniform(0.5, 2.0, 9)
    target[4] += 3.0
    weight[4] = 0.0

    _assert_same(align_similarity(source, target, weight), planted)


def test_points_near_a_line_are_told_from_others(draw):
    along = draw.normal(9)[:, None] * draw.directions(1)

    assert are_on_a_line(along + 0.01 * draw.normal(9, 3), 0.05)
    assert not are_on_a_line(along + 0.01 * draw.normal(9, 3), 0.002)
    assert are_on_a_line(draw.normal(2, 3), 0.0)
