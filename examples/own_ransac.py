"""RANSAC of one's own: the relative pose of two photographs from `tr.minimal`, every hypothesis at once.

    python examples/own_ransac.py [--samples 500] [--max-error 3.0]

Two photographs of the embedded tank are matched. Four matches and the measured verticals give up to six poses of the
second camera relative to the first; a match agrees with a pose when the point where its two rays come nearest to each
other, in the water, is seen within a few pixels of both keypoints. The best pose is adjusted once with all matches that
agree, which takes in that the verticals are measured to half a degree only, and is compared with the truth, and with
what a whole run finds from all eight photographs.
"""

import argparse
import math
from typing import NamedTuple

import torch
from torch import Tensor

import torchrefrac as tr
from torchrefrac.features import MatchOptions, SiftOptions, extract_sift, match
from torchrefrac.geometry import heading_rotation, level_rotation, split_heading
from torchrefrac.ransac import level_rays

HEIGHT = 30.0  # of the first camera above the water, cm: the only length that is known
GRAVITY_SIGMA = math.radians(0.5)


class Pair(NamedTuple):
    """Two photographs: a capture of them, and pixels (2, n, 2) of their matches."""

    capture: tr.Capture
    pixels: Tensor


class Pose(NamedTuple):
    """Of both cameras: rotations cam_from_world (..., 2, 3, 3) and centres (..., 2, 3); the first one at (0, 0, h)."""

    rotation: Tensor
    center: Tensor


def main() -> None:
    parser = argparse.ArgumentParser(description="The relative pose of two photographs by RANSAC.")
    parser.add_argument("--samples", type=int, default=500, help="samples of four matches")
    parser.add_argument("--max-error", type=float, default=3.0, help="what a match that agrees may be off by, pixels")
    arguments = parser.parse_args()
    folder = tr.embedded_scene("tank_small")
    pair = matched(tr.load_capture(folder))
    pose, agrees = ransac(pair, arguments.samples, arguments.max_error, torch.Generator().manual_seed(0))
    print(f"{int(agrees.sum())} of {len(agrees)} matches agree with the best pose")
    truth = tr.load_truth(folder)
    assert truth is not None
    true_pose = relative(truth.rotation[:2], truth.center[:2])
    report("RANSAC", pose, true_pose)
    report("adjusted", adjusted(pair, pose, agrees), true_pose)
    views = tr.reconstruct(pair.capture).views
    report("a run of all eight", relative(views.rotation[:2], views.center[:2]), true_pose)


def ransac(pair: Pair, samples: int, max_error: float, generator: torch.Generator) -> tuple[Pose, Tensor]:
    """The pose that has the least sum of squared errors, each cut off at `max_error`, and the matches within it."""
    pixels, capture = pair.pixels, pair.capture
    levels = level_rotation(capture.down_in_cam[:2])
    rays = level_rays(capture.cameras[0].plane_from_pixels(pixels), levels)
    chosen = torch.rand(samples, pixels.shape[1], generator=generator).topk(4, dim=1).indices
    heading, center, valid = tr.minimal.relative_pose_4pt(rays[0, chosen], rays[1, chosen], capture.index_ratio, HEIGHT)
    heading, center = heading[valid], center[valid]
    both = torch.stack((torch.zeros_like(heading), heading), dim=-1)
    above = center.new_tensor((0.0, 0.0, HEIGHT)).expand_as(center)
    poses = Pose(levels @ heading_rotation(both), torch.stack((above, center), dim=-2))
    squared, _ = errors(pair, poses)
    best = int(squared.clamp(max=max_error**2).sum(dim=1).argmin())
    return Pose(poses.rotation[best], poses.center[best]), squared[best] < max_error**2


def errors(pair: Pair, poses: Pose) -> tuple[Tensor, Tensor]:
    """Squared pixels (..., n), the larger of both images', infinite for rays that do not meet in the water; points."""
    cameras = cameras_of(pair, poses)[..., None]  # (..., 2, 1), over n matches
    origins, directions, cast = cameras.cast_rays(pair.pixels)
    points, meet = tr.minimal.triangulate(origins.transpose(-3, -2), directions.transpose(-3, -2))
    seen, valid = cameras.project(points[..., None, :, :])
    possible = meet & (points[..., 2] < 0.0) & (cast & valid).all(dim=-2)
    squared = (seen - pair.pixels).square().sum(dim=-1).amax(dim=-2)
    return torch.where(possible, squared, torch.inf), points


def cameras_of(pair: Pair, poses: Pose) -> tr.RefractiveCamera:
    return tr.RefractiveCamera(pair.capture.cameras[0], *poses, tr.FlatInterface(pair.capture.index_ratio))


def adjusted(pair: Pair, pose: Pose, agrees: Tensor) -> Pose:
    """With all matches that agree; verticals are measurements. The first camera keeps its place."""
    right = Pair(pair.capture, pair.pixels[:, agrees])
    start = Pose(pose.rotation[None], pose.center[None])
    _, points = errors(right, start)
    down = pair.capture.down_in_cam[None, :2]
    ones = torch.ones_like(right.pixels[None, ..., 0])
    problem = tr.BundleBatch(cameras_of(pair, start), points, right.pixels[None], ones, down, GRAVITY_SIGMA)
    fixed = torch.zeros(2, 6, dtype=torch.bool)
    fixed[0, 3:] = True
    cameras = tr.adjust_each(problem, fixed=fixed, pixel_sigma=0.5).cameras
    return relative(cameras.cam_from_world_rotation[0], cameras.center_in_world[0])


def matched(capture: tr.Capture) -> Pair:
    first, second = (extract_sift(path, SiftOptions()) for path in capture.paths[:2])
    # No ratio test, so that there are wrong matches.
    rows = match(first.unit(), second.unit(), MatchOptions(ratio=1.0))
    return Pair(capture, torch.stack((first.pixels[rows[:, 0]], second.pixels[rows[:, 1]])))


def relative(rotation: Tensor, center: Tensor) -> Pose:
    """Poses of two cameras where the first is above the origin and has heading 0."""
    _, heading = split_heading(rotation[0])
    turn = heading_rotation(heading)
    below = center[0] * center.new_tensor((1.0, 1.0, 0.0))
    return Pose(rotation @ turn.mT, (center - below) @ turn.mT)


def report(name: str, pose: Pose, truth: Pose) -> None:
    """How far the second camera is from where it truly stands, and turned."""
    off = float((pose.center[1] - truth.center[1]).norm())
    turned = pose.rotation[1] @ truth.rotation[1].mT
    angle = math.degrees(math.acos(min(1.0, (float(turned.diagonal().sum()) - 1.0) / 2.0)))
    print(f"{name:<20} second camera off by {off:6.3f} cm and {angle:6.3f} degrees")


if __name__ == "__main__":
    main()
