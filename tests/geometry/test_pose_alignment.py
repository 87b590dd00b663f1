"""How two frames lie to each other by poses that are known in both."""

import pytest
import torch

from tests.tolerances import assert_matches
from torchrefrac.geometry import Freedom, Rigid, Similarity, align_poses, heading_rotation, so3_exp

REACH, ANGLE = 40.0, 0.03


@pytest.fixture
def planted(draw):
    """`planted(freedom)`: a similarity that leaves what the freedom does."""

    def make(freedom):
        level = freedom is Freedom.LEVEL
        rotation = heading_rotation(draw.uniform(-3.0, 3.0)) if level else draw.rotations()
        shift = 50.0 * draw.normal(3) * torch.tensor((1.0, 1.0, 0.0 if level else 1.0))
        scale = torch.tensor(1.0 if freedom is Freedom.RIGID else 0.3, dtype=torch.float64)
        return Similarity(scale, rotation, shift)

    return make


@pytest.fixture
def poses(draw):
    """`poses(count, b_from_a)`: in a and in b."""

    def make(count, b_from_a):
        in_a = Rigid(draw.rotations(count), 10.0 * draw.normal(count, 3) + torch.tensor((0.0, 0.0, 30.0)))
        return in_a, Rigid(b_from_a.apply_to_rotation(in_a.rotation), b_from_a.apply(in_a.center))

    return make


def assert_same(found, planted):
    assert_matches(found.scale, planted.scale)
    assert_matches(found.rotation, planted.rotation)
    assert_matches(found.translation, planted.translation)


@pytest.mark.parametrize("freedom", Freedom)
def test_as_few_poses_as_it_needs_give_the_planted_similarity(planted, poses, freedom):
    b_from_a = planted(freedom)

    found = align_poses(*poses(freedom.poses, b_from_a), freedom, REACH, ANGLE)

    assert found.agreeing.all()
    assert_same(found.b_from_a, b_from_a)


@pytest.mark.parametrize("freedom", Freedom)
def test_wrong_poses_among_more_right_ones_do_not_agree(planted, poses, draw, freedom):
    b_from_a = planted(freedom)
    in_a, in_b = poses(6, b_from_a)
    turned = in_b.rotation.clone()
    turned[1] = so3_exp(torch.tensor((0.0, 0.2, 0.0)).double()) @ turned[1]
    moved = in_b.center.clone()
    moved[4] += 10.0

    found = align_poses(in_a, Rigid(turned, moved), freedom, REACH, ANGLE)

    assert found.agreeing.tolist() == [True, False, True, True, False, True]
    assert_same(found.b_from_a, b_from_a)


def test_small_errors_of_many_poses_average_out(planted, poses, draw):
    b_from_a = planted(Freedom.LEVEL)
    in_a, in_b = poses(50, b_from_a)
    noisy = Rigid(so3_exp(0.003 * draw.normal(50, 3)) @ in_b.rotation, in_b.center + 0.03 * draw.normal(50, 3))

    found = align_poses(in_a, noisy, Freedom.LEVEL, REACH, ANGLE)

    assert found.agreeing.all()
    assert (found.b_from_a.apply(in_a.center) - in_b.center).norm(dim=-1).max() < 0.1


def test_one_pose_leaves_the_scale_open_where_no_plane_is_known(planted, poses):
    assert align_poses(*poses(1, planted(Freedom.SIMILARITY)), Freedom.SIMILARITY, REACH, ANGLE) is None


def test_similarities_compose_and_have_inverses(planted, draw):
    first, second, points = planted(Freedom.SIMILARITY), planted(Freedom.SIMILARITY), draw.normal(5, 3)

    assert_matches((second @ first).apply(points), second.apply(first.apply(points)))
    assert_matches(first.inverse.apply(first.apply(points)), points)
