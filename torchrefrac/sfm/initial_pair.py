"""The pair of images that the reconstruction grows from."""

from collections.abc import Sequence

import torch

from torchrefrac.scene import Capture, Tracks
from torchrefrac.sfm.model import SparseModel
from torchrefrac.sfm.options import SfmOptions
from torchrefrac.sfm.triangulation import triangulate_tracks
from torchrefrac.sfm.verification import VerifiedPair


def rank_initial_pairs(pairs: Sequence[VerifiedPair], options: SfmOptions) -> list[VerifiedPair]:
    """Best first: most inliers among the pairs with a sufficient baseline, then the others by their angle.

    Pairs that determine no pose are left out.
    """

    def key(pair: VerifiedPair) -> tuple[bool, float]:
        wide = pair.pose.median_angle >= options.min_initial_angle_deg * torch.pi / 180.0
        return wide, len(pair.pair) if wide else pair.pose.median_angle

    return sorted((pair for pair in pairs if pair.pose.rotation is not None), key=key, reverse=True)


def start_from_pair(
    pair: VerifiedPair,
    tracks: Tracks,
    capture: Capture,
    index_ratio: torch.Tensor,
    options: SfmOptions,
) -> SparseModel:
    """The model of two registered images and the points that both see."""
    if pair.pose.rotation is None or pair.pose.center is None:
        raise ValueError("pair has no pose to start from")
    model = SparseModel.empty(tracks, len(capture), capture.intrinsics, index_ratio)
    images = [pair.pair.first, pair.pair.second]
    return triangulate_tracks(model.with_poses(images, pair.pose.rotation, pair.pose.center), options)
