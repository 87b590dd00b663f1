"""Poses of pairs as arrays and back."""

import torch

from torchrefrac.files.npz import read_arrays, write_arrays
from torchrefrac.geometry import so3_exp
from torchrefrac.sfm import PairPose
from torchrefrac.sfm.pair_arrays import POSES, packed, unpacked


def test_poses_of_every_kind_come_back_from_a_file(draw, tmp_path):
    def some(count):
        return draw.uniform(0.0, 1.0, count) < 0.5

    whole = PairPose(so3_exp(draw.normal(2, 3)), draw.normal(2, 3), some(7), 0.25, some(7))
    undetermined, nobody_looked = PairPose(None, None, some(4), 0.0), PairPose(*[*_pose(whole), some(3), 0.5])
    poses = [whole, None, undetermined, nobody_looked]

    write_arrays(packed(poses, [7, 5, 4, 3]), tmp_path / "poses.npz")
    found = unpacked(read_arrays(tmp_path / "poses.npz", POSES.arrays, ValueError))

    assert found[1] is None
    for before, after in ((whole, found[0]), (undetermined, found[2]), (nobody_looked, found[3])):
        assert after.median_angle == before.median_angle
        for name in ("rotation", "center", "inliers", "straight"):
            one, other = getattr(before, name), getattr(after, name)
            assert (one is None and other is None) or torch.equal(one, other)


def test_none_are_an_empty_list():
    assert unpacked(packed([], [])) == []


def _pose(pair):
    return pair.rotation, pair.center
