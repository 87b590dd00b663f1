"""Poses without refraction, for the baselines: OpenCV's essential matrix and PnP.

Those without refraction need a polish: adjust, judge the data again, adjust again.
"""

from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchrefrac.bundle import BundleOptions, adjust, adjust_pose
from torchrefrac.camera import Intrinsics
from torchrefrac.geometry import Rigid, level_rotation
from torchrefrac.numerics import thin
from torchrefrac.optim import LevenbergMarquardtOptions
from torchrefrac.scene import Cameras, Capture, Interfaces, Observations, Scene, reprojection_errors
from torchrefrac.sfm.pose import OneByOne, PairPose, Pixels, Pose, Resection, cameras_of, judge_pair, meet
from torchrefrac.sfm.rules import SfmOptions

MIN_ESSENTIAL = 8
MIN_PNP = 6
ROUNDS = 2
MIN_PAIR_INLIERS, MIN_VIEW_INLIERS = 6, 3
MAX_MATCHES = 400
PAIR_SOLVER = LevenbergMarquardtOptions(max_iterations=8, function_tolerance=1e-3)


@dataclass(frozen=True)
class PinholeInitializer(OneByOne):
    """Ordinary pinhole poses, as a reconstruction that ignores the water finds them. Gravity only levels the frame.

    Of cameras whose intrinsics are uncertain those matches agree that have any epipolar geometry in common: what
    intrinsics that are not yet adjusted make of the pair may be many pixels off.
    """

    capture: Capture
    options: SfmOptions

    @property
    def index_ratio(self) -> float:
        return 1.0

    def relative(self, images: tuple[int, int], pixels: Pixels, generator: torch.Generator) -> PairPose | None:
        if len(pixels[0]) < MIN_ESSENTIAL:
            return None
        self._seed(generator)
        capture, options = self.capture, self.options.ransac
        plane1, plane2 = capture.planes(images, pixels)
        threshold = options.max_error / capture.typical_focal(*images)
        found = essential_pose(plane1, plane2, cv2.USAC_DEFAULT, options.confidence, threshold)
        if found is None:
            return None
        relative, translation, inliers = found
        cam1_from_world = level_rotation(capture.down_in_cam[images[0]])
        first = torch.tensor((0.0, 0.0, 1.0), dtype=torch.float64)
        baseline = -(cam1_from_world.T @ relative.T @ translation)
        rotation = torch.stack((cam1_from_world, relative @ cam1_from_world))
        pose = Rigid(rotation, torch.stack((first, first + baseline)))
        cameras, camera = capture.cameras, capture.camera[list(images)]
        found = refine_pair(pose, pixels, inliers, cameras, camera, self.options.bundle, options.max_error)
        if not cameras.are_uncertain:
            return found
        agree = torch.zeros_like(inliers).index_fill(0, fundamental_consensus(*pixels, options.max_error), True)
        return replace(found, inliers=agree | found.inliers, straight=None)

    def absolute(self, image: Resection, generator: torch.Generator) -> Pose | None:
        self._seed(generator)
        options = self.options.ransac
        _, intrinsics, pixels, points = image
        pose = pose_of_points(intrinsics, pixels, points, options.max_error, options.confidence)
        return pose and refine_pose(pose, pixels, points, intrinsics, self.options.bundle, options.max_error)

    @staticmethod
    def _seed(generator: torch.Generator) -> None:
        cv2.setRNGSeed(int(torch.randint(1 << 30, (), generator=generator)))


def pose_of_points(
    intrinsics: Intrinsics,
    pixels: Float[Tensor, "k 2"],
    points: Float[Tensor, "k 3"],
    max_error: float,
    confidence: float = 0.999,
) -> Pose | None:
    """Pose of a camera without refraction that sees known points, and those that agree within max_error pixels, by
    OpenCV's RANSAC; None where there is none, or fewer than MIN_PNP do."""
    if len(pixels) < MIN_PNP:
        return None
    result: Any = cv2.solvePnPRansac(
        points.numpy(),
        intrinsics.plane_from_pixels(pixels).numpy(),
        np.eye(3),
        None,
        iterationsCount=1000,
        reprojectionError=max_error / float(intrinsics.focal.mean()),
        confidence=confidence,
        flags=cv2.SOLVEPNP_SQPNP,
    )
    found, rotation_vector, translation, rows = result  # OpenCV's stubs do not know that the last may be None
    if not found or rows is None or len(rows) < MIN_PNP:
        return None
    rotation = torch.from_numpy(cv2.Rodrigues(rotation_vector)[0])
    center = -(rotation.T @ torch.from_numpy(translation[:, 0]))
    inliers = torch.zeros(len(pixels), dtype=torch.bool)
    inliers[torch.from_numpy(rows[:, 0]).long()] = True
    return Pose(rotation, center, inliers)


def essential_pose(
    plane1: Float[Tensor, "k 2"], plane2: Float[Tensor, "k 2"], method: int, confidence: float, threshold: float
) -> tuple[Float[Tensor, "3 3"], Float[Tensor, "3"], Bool[Tensor, " k"]] | None:
    """Relative rotation, direction of the translation and consensus of OpenCV's essential matrix."""
    one, two, ideal = plane1.numpy(), plane2.numpy(), np.eye(3)
    found: Any
    try:
        found = cv2.findEssentialMat(one, two, ideal, method, confidence, threshold)
    except cv2.error:  # see `fundamental_consensus`
        found = cv2.findEssentialMat(one, two, ideal, cv2.RANSAC, confidence, threshold)
    essential, mask = found
    if essential is None or essential.shape != (3, 3):
        return None
    _, rotation, translation, mask = cv2.recoverPose(essential, one, two, ideal, mask=mask)
    inliers = torch.from_numpy(mask[:, 0] > 0)
    if int(inliers.sum()) < MIN_ESSENTIAL:
        return None
    return torch.from_numpy(rotation), torch.from_numpy(translation[:, 0]), inliers


def fundamental_consensus(
    pixels1: Float[Tensor, "n 2"], pixels2: Float[Tensor, "n 2"], max_error: float
) -> Int[Tensor, " k"]:
    """Which matches agree within max_error pixels on an epipolar geometry, of lenses that nobody knows.

    OpenCV's newer estimators end in an error where the polished model of their last step comes out empty; its plain
    RANSAC then decides.
    """
    if len(pixels1) < MIN_ESSENTIAL:
        return torch.zeros(0, dtype=torch.long)
    both = pixels1.numpy(), pixels2.numpy()
    found: Any
    try:
        found = cv2.findFundamentalMat(*both, cv2.USAC_DEFAULT, max_error, 0.999, 10_000)
    except cv2.error:
        found = cv2.findFundamentalMat(*both, cv2.FM_RANSAC, max_error, 0.999, 10_000)
    _, mask = found
    return torch.zeros(0, dtype=torch.long) if mask is None else torch.from_numpy(mask[:, 0] > 0).nonzero()[:, 0]


def refine_pair(
    pose: Rigid,
    pixels: Pixels,
    inliers: Bool[Tensor, " k"],
    cameras: Cameras,
    camera: Int[Tensor, " 2"],
    options: BundleOptions,
    max_error: float,
) -> PairPose:
    """Two-view bundle adjustment without refraction from the rough pose of two views, which have the cameras `camera`.

    `inliers` start it; afterwards a match is an inlier when its point reprojects within max_error in both images.
    The adjustment takes MAX_MATCHES of them, evenly: more do not change the verdict on the rest.
    """
    both, air, intrinsics = torch.stack(pixels, dim=1), Interfaces.level(1.0), cameras.of_views(camera)
    options = replace(options, refine=(), solver=PAIR_SOLVER)
    found = PairPose(pose.rotation, pose.center, inliers, 0.0)
    for _ in range(ROUNDS):
        rows = thin(inliers.nonzero()[:, 0], MAX_MATCHES)
        points, _, _ = meet(cameras_of(intrinsics, pose, air.index_ratio[0]), both[rows])
        seen = Observations(
            view=torch.arange(2).repeat(len(rows)),
            point=torch.arange(len(rows)).repeat_interleave(2),
            pixels=both[rows].flatten(0, 1),
        )
        scene = Scene.create(pose, cameras, air, points, seen, camera=camera)
        pose = adjust(scene, options, check=False).scene.views.pose
        found = judge_pair(pose, pixels, intrinsics, air.index_ratio[0], max_error)
        inliers = found.inliers
        if int(inliers.sum()) < MIN_PAIR_INLIERS:
            break
    return found


def refine_pose(
    pose: Pose,
    pixels: Float[Tensor, "k 2"],
    points: Float[Tensor, "k 3"],
    intrinsics: Intrinsics,
    options: BundleOptions,
    max_error: float,
) -> Pose:
    """Adjust one camera without refraction to its inliers, twice; inliers are then those within max_error."""
    for _ in range(ROUNDS):
        count = torch.arange(int(pose.inliers.sum()))
        seen = Observations(torch.zeros_like(count), count, pixels[pose.inliers])
        rigid, air = Rigid(pose.rotation[None], pose.center[None]), Interfaces.level(1.0)
        adjusted = adjust_pose(Scene.create(rigid, intrinsics, air, points[pose.inliers], seen), options).scene
        inliers = reprojection_errors(adjusted.camera_of(0), points, pixels) < max_error
        pose = Pose(adjusted.views.rotation[0], adjusted.views.center[0], inliers)
        if int(inliers.sum()) < MIN_VIEW_INLIERS:
            break
    return pose
