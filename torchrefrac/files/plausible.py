"""Intrinsics that no lens has, refused in whatever file they stand: wrong units, lost digits, columns that moved."""

import torch

from torchrefrac.camera import Intrinsics, distort

FOCAL_RANGE = 0.05, 1000.0
"""Of focal lengths, in units of the image's longer side: fields of view of 170 to 0.06 degrees."""
MOST_MOVED = 10.0
"""How far distortion may move a corner of the image, in units of its distance from the principal point."""


def implausible(intrinsics: Intrinsics) -> tuple[str, str] | None:
    """The name of a number that cannot be right, and what is wrong with it; None where all can be."""
    longer = max(intrinsics.width, intrinsics.height)
    low, high = (share * longer for share in FOCAL_RANGE)
    for name, focal in zip(("fx", "fy"), intrinsics.focal.tolist(), strict=True):
        if not low <= focal <= high:
            return name, f"is {focal:g}, but with images {longer} pixels long must lie between {low:g} and {high:g}"
    sizes = (intrinsics.width, intrinsics.height)
    for name, center, size in zip(("cx", "cy"), intrinsics.principal_point.tolist(), sizes, strict=True):
        if not 0.0 <= center <= size:
            wanted = f"the principal point must lie in the image, which has {size} pixels that way"
            return name, f"is {center:g} from the edge, but {wanted}"
    corners = torch.cartesian_prod(*(intrinsics.focal.new_tensor((0.0, size)) for size in sizes))
    plane = (corners - intrinsics.principal_point) / intrinsics.focal
    moved, reach = (
        (to - plane).norm(dim=-1)
        for to in (distort(plane, intrinsics.distortion, intrinsics.fisheye), torch.zeros_like(plane))
    )
    if not bool((moved <= MOST_MOVED * reach).all()):
        problem = f"moves a corner of the image by more than {MOST_MOVED:g} times its distance from the principal point"
        return "distortion", f"is {intrinsics.distortion.tolist()}, which {problem}; calibrate again"
    return None
