"""Poses of pairs as arrays, for files and other processes."""

from collections.abc import Sequence

import numpy as np
import torch

from torchrefrac.files.work import Arrays, Form
from torchrefrac.sfm.pose import PairPose

NONE, AGREEING, DETERMINED = 0, 1, 2
"""Kinds: without a pose, with inliers that do not determine it, with a pose."""
POSES = Form({
    **{"kind": "i:p", "count": "i:p", "median_angle": "f:p", "rotation": "f:p233", "center": "f:p23"},
    **{"inliers": "b:k", "looked": "b:p", "straight": "b:k"},
})  # fmt: skip
"""Of p pairs with `count` matches each, k in all. looked: whether any that are no inliers were looked at straight."""


def packed(poses: Sequence[PairPose | None], counts: Sequence[int]) -> Arrays:
    """Poses of pairs with so many matches."""
    total, ends = sum(counts), np.cumsum([0, *counts])
    arrays = {
        "kind": np.full(len(poses), NONE),
        "count": np.array(counts, dtype=np.int64),
        "median_angle": np.zeros(len(poses)),
        "rotation": np.tile(np.eye(3), (len(poses), 2, 1, 1)),
        "center": np.zeros((len(poses), 2, 3)),
        "inliers": np.zeros(total, dtype=np.bool_),
        "looked": np.zeros(len(poses), dtype=np.bool_),
        "straight": np.zeros(total, dtype=np.bool_),
    }
    for i, pose in enumerate(poses):
        if pose is None:
            continue
        own = slice(ends[i], ends[i + 1])
        arrays["kind"][i], arrays["median_angle"][i] = AGREEING, pose.median_angle
        arrays["inliers"][own] = pose.inliers.numpy()
        if pose.straight is not None:
            arrays["looked"][i], arrays["straight"][own] = True, pose.straight.numpy()
        if pose.rotation is not None and pose.center is not None:
            arrays["kind"][i] = DETERMINED
            arrays["rotation"][i], arrays["center"][i] = pose.rotation.numpy(), pose.center.numpy()
    return arrays


def unpacked(arrays: Arrays) -> list[PairPose | None]:
    """What was packed."""
    counts = arrays["count"].tolist()
    inliers, straight = (torch.from_numpy(arrays[name]).split(counts) for name in ("inliers", "straight"))
    rotation, center = (torch.from_numpy(arrays[name]).double() for name in ("rotation", "center"))
    return [
        None
        if kind == NONE
        else PairPose(
            rotation[i] if kind == DETERMINED else None,
            center[i] if kind == DETERMINED else None,
            inliers[i],
            float(arrays["median_angle"][i]),
            straight[i] if arrays["looked"][i] else None,
        )
        for i, kind in enumerate(arrays["kind"].tolist())
    ]
