"""What an initialiser must be able to do: the pose of a pair, and of one more view; and which matches agree on one."""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchrefrac.camera import Intrinsics, RefractiveCamera
from torchrefrac.geometry import Plane, Rigid
from torchrefrac.minimal import triangulate
from torchrefrac.refraction import FlatInterface
from torchrefrac.scene.interfaces import without_water
from torchrefrac.sfm.rays import Rays

DEEPEST = 5.0  # times the height of the cameras, of what is seen straight below the water's level

Pixels = tuple[Float[Tensor, "k 2"], Float[Tensor, "k 2"]]


class Resection(NamedTuple):
    """What the pose of an image follows from: the intrinsics of its camera, and known points with their pixels."""

    image: int
    intrinsics: Intrinsics
    pixels: Float[Tensor, "k 2"]
    points: Float[Tensor, "k 3"]


@dataclass(frozen=True, eq=False)
class Pose:
    """Rotation cam_from_world and centre, in the unit of the points, and which data agree."""

    rotation: Float[Tensor, "3 3"]
    center: Float[Tensor, "3"]
    inliers: Bool[Tensor, " k"]


@dataclass(frozen=True, eq=False)
class PairPose:
    """Two cameras in a frame and a unit of their own, which matches agree, and the median angle (radians) between their
    rays. Without a pose where the inliers agree on one but do not determine it. straight: other matches that agree if
    nothing is bent, below the water's level; None: nobody looked."""

    rotation: Float[Tensor, "2 3 3"] | None
    center: Float[Tensor, "2 3"] | None
    inliers: Bool[Tensor, " k"]
    median_angle: float
    straight: Bool[Tensor, " k"] | None = None


class PoseInitializer(Protocol):
    """Finds poses without a starting value; None where the data do not carry one."""

    @property
    def index_ratio(self) -> float:
        """Index ratio n_water / n_air; 1 where the initialiser knows no refraction."""
        ...

    def relative(self, images: tuple[int, int], pixels: Pixels, generator: torch.Generator) -> PairPose | None:
        """Pose of two images from matched pixels."""
        ...

    def relative_each(
        self, images: Sequence[tuple[int, int]], pixels: Sequence[Pixels], generators: Sequence[torch.Generator]
    ) -> list[PairPose | None]:
        """Poses of some pairs of images from matched pixels, each with draws of its own; best in one call for pairs
        that have about as many matches."""
        ...

    def absolute(self, image: Resection, generator: torch.Generator) -> Pose | None:
        """Pose of an image, in the unit of the points that it sees."""
        ...

    def absolute_each(self, images: Sequence[Resection], generators: Sequence[torch.Generator]) -> list[Pose | None]:
        """Poses of some images, each with draws of its own; best in one call for images that see about as much."""
        ...


class OneByOne:
    """For an initialiser that finds the poses of pairs, and of images, one after the other."""

    def relative(self, images: tuple[int, int], pixels: Pixels, generator: torch.Generator) -> PairPose | None:
        raise NotImplementedError

    def relative_each(
        self, images: Sequence[tuple[int, int]], pixels: Sequence[Pixels], generators: Sequence[torch.Generator]
    ) -> list[PairPose | None]:
        return [self.relative(*pair) for pair in zip(images, pixels, generators, strict=True)]

    def absolute(self, image: Resection, generator: torch.Generator) -> Pose | None:
        raise NotImplementedError

    def absolute_each(self, images: Sequence[Resection], generators: Sequence[torch.Generator]) -> list[Pose | None]:
        return [self.absolute(*each) for each in zip(images, generators, strict=True)]


def draws_of(seed: int, *images: int) -> torch.Generator:
    """Random numbers that belong to an image or a pair: whatever the others are, and however often these are asked."""
    number = hashlib.sha256(repr((seed, *images)).encode()).digest()[:8]
    return torch.Generator().manual_seed(int.from_bytes(number, "big"))


def judge_pair(
    pose: Rigid,
    pixels: Pixels,
    intrinsics: Intrinsics,
    index_ratio: Float[Tensor, ""],
    max_error: float,
    dry: Bool[Tensor, " k"] | None = None,
) -> PairPose:
    """Which matches, of points in the water or in air, reproject within max_error in both images of a pose. dry: those
    without water before them, by default none."""
    both = torch.stack(pixels, dim=1)
    camera = cameras_of(intrinsics, pose, index_ratio, None if dry is None else dry[:, None])
    points, angle, valid = meet(camera, both)
    projected, possible = camera.project(points[:, None])
    error = (projected - both).norm(dim=-1).amax(dim=-1)
    inliers = valid & possible.all(dim=-1) & (error < max_error)
    median = float(angle[inliers].median()) if bool(inliers.any()) else 0.0
    return PairPose(pose.rotation, pose.center, inliers, median, _straight(camera, both, inliers, max_error))


def _straight(
    camera: RefractiveCamera, both: Float[Tensor, "k 2 2"], inliers: Bool[Tensor, " k"], max_error: float
) -> Bool[Tensor, " k"]:
    """Which matches that are no inliers reproject within max_error from a place below the surface, seen straight."""
    straight, rows = torch.zeros_like(inliers), (~inliers).nonzero()[:, 0]
    pinholes = RefractiveCamera(
        camera.intrinsics, camera.cam_from_world_rotation, camera.center_in_world, FlatInterface(1.0), check=False
    )
    points, valid = triangulate(pinholes.center_in_world.expand(len(rows), 2, 3), pinholes.view_directions(both[rows]))
    projected, possible = pinholes.project(points[:, None])
    error = (projected - both[rows]).norm(dim=-1).amax(dim=-1)
    deepest = -DEEPEST * float(pinholes.center_in_world[:, 2].max())
    below = (points[:, 2] < 0.0) & (points[:, 2] > deepest)
    return straight.index_copy(0, rows, valid & possible.all(dim=-1) & (error < max_error) & below)


def meet(
    camera: RefractiveCamera, both: Float[Tensor, "k 2 2"]
) -> tuple[Float[Tensor, "k 3"], Float[Tensor, " k"], Bool[Tensor, " k"]]:
    """Where the rays of matches meet above and below a level surface, at which angle, and whether they do."""
    return Rays.of(camera, both).meet(lambda points: points[..., 2])


def cameras_of(
    intrinsics: Intrinsics, pose: Rigid, index_ratio: Float[Tensor, ""], dry: Bool[Tensor, "k 1"] | None = None
) -> RefractiveCamera:
    """Those of a pair, above a level surface; or a pair for each of k matches, without water where it is `dry`."""
    plane = Plane() if dry is None else Plane(offset=without_water(torch.zeros_like(index_ratio), dry), check=False)
    interface = FlatInterface(index_ratio, plane=plane)
    return RefractiveCamera(intrinsics, pose.rotation, pose.center, interface, check=False)
