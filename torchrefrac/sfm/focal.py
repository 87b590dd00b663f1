"""Focal lengths with which the matches agree with the stated gravity: where nobody knows them, before anything is
placed; and where nothing agrees with those stated, after.

Verticals and refraction fix the focal length. Where it is grossly wrong no vertical fits, so that gravity is
contradicted in most images, or most cannot be registered. The best pairs are then tried with focal lengths over the
whole range of lenses, with gravity as it was stated: under the right one the matches of every pair agree, and better by
far than in the reconstruction, whatever vertical that has taken.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from torchrefrac.features import Features, PairMatches
from torchrefrac.geometry import level_rotation
from torchrefrac.minimal import relative_pose_npt
from torchrefrac.numerics import thin
from torchrefrac.ransac.pose import level_rays, refine_in_stages
from torchrefrac.refinement import TwoViews
from torchrefrac.scene import Capture, Scene
from torchrefrac.sfm.gravity import contradicted_gravity
from torchrefrac.sfm.pinhole import fundamental_consensus
from torchrefrac.sfm.rules import SfmOptions
from torchrefrac.sfm.vertical import image_planes

PAIRS, MATCHES = 3, 100
STAGES = ((3.0, 4), (1.0, 6))
"""Of the refinement of a pose: how far the allowed error is widened, and the iterations."""
COARSE, WIDEST, PARTS = math.log(1.5), 7, 4
"""A step of the logarithm of the focal length, how many are tried to either side, and into how many parts the last one
is divided."""
GROSS = 0.9 * COARSE
"""Logarithm of the least factor that is looked for."""
BETTER = 0.5
"""Error, as a share of that with the focal length stated, at which another one explains the matches better."""


UNKNOWN = 0.1
"""Relative sigma of a focal length from which on it is looked for."""


def with_likely_focals(
    capture: Capture,
    matches: Sequence[PairMatches],
    features: Sequence[Features],
    index_ratio: float,
    options: SfmOptions,
) -> Capture:
    """The capture with focal lengths under which the best pairs of images of one camera agree with gravity, of cameras
    that do not know theirs; within three times its sigma. As it is where gravity of such pairs is not known."""
    cameras, focal = capture.cameras, capture.cameras.focal.clone()
    for camera in (cameras.focal_sigma > UNKNOWN).nonzero()[:, 0].tolist():
        usable = (capture.camera == camera) & capture.down_sigma.isfinite()
        own = [pair for pair in matches if bool(usable[[pair.first, pair.second]].all())]
        pairs = _best_pairs(own, capture, features, torch.tensor(index_ratio, dtype=torch.float64), options)
        if pairs:
            reach = min(math.ceil(3.0 * float(cameras.focal_sigma[camera]) / COARSE), WIDEST)
            focal[camera] *= math.exp(_refined(pairs, _best(pairs, COARSE * _steps(reach))[0])[0])
    if torch.equal(focal, cameras.focal):
        return capture
    return replace(capture, cameras=cameras.moved(focal, cameras.principal_point, cameras.distortion, 0))


def better_focal(
    scene: Scene,
    stated: Capture,
    matches: Sequence[PairMatches],
    features: Sequence[Features],
    options: SfmOptions,
) -> tuple[float, float] | None:
    """Logarithm of the factor by which focal lengths would have to change for matches to agree with the gravity that
    was `stated`, and its standard deviation.

    None where gravity agrees with the reconstruction `scene` of the same photographs, no factor explains the matches
    twice as well as that does, or the change is less than GROSS, which shows in the reconstruction.
    """
    if not stated.has_gravity or not _contradicted(scene, stated):
        return None
    pairs = _best_pairs(matches, stated, features, scene.interfaces.index_ratio[0], options)
    if not pairs:
        return None
    rough, each = _best(pairs, COARSE * _steps(WIDEST))
    agree = (each - rough).abs() < 1.5 * COARSE
    if 2 * int(agree.sum()) <= len(pairs):
        return None
    found, each = _refined(pairs, rough)
    if abs(found) < GROSS:
        return None
    error = torch.tensor([pair.error(math.exp(found)) for pair in pairs]).square().mean().sqrt()
    now = torch.tensor([pair.error_now(scene) for pair in pairs]).square().mean().sqrt()
    if float(error) > BETTER * float(now):
        return None
    scatter = (each - found)[agree].square().mean().sqrt()
    return found, math.hypot(COARSE / PARTS / math.sqrt(12.0), float(scatter))


def _contradicted(scene: Scene, stated: Capture) -> bool:
    """Whether half of the views have no place, or most of those that have one contradict gravity."""
    wrong = contradicted_gravity(scene, stated.down_in_cam, stated.down_sigma)
    registered = scene.views.num_registered
    return 2 * registered < len(scene.views) or 2 * int(wrong.sum()) > registered


@dataclass(frozen=True, eq=False)
class _Pair:
    """Two images and the matches that agree on an epipolar geometry, whatever the focal lengths."""

    images: list[int]
    views: TwoViews
    max_error: float

    @classmethod
    def of(
        cls,
        stated: Capture,
        pair: PairMatches,
        features: Sequence[Features],
        index_ratio: Float[Tensor, ""],
        options: SfmOptions,
    ) -> "_Pair":
        images = [pair.first, pair.second]
        plane1, plane2 = image_planes(stated, features, pair)
        focal = stated.intrinsics_of(images).focal
        one, two = focal.expand(2, 2)
        rows = thin(fundamental_consensus(plane1 * one, plane2 * two, options.ransac.max_error), MATCHES)
        views = TwoViews(
            plane1[rows],
            plane2[rows],
            cam_from_level=level_rotation(stated.down_in_cam[images]),
            focal=focal,
            index_ratio=index_ratio,
            gravity_sigma=float(stated.down_sigma[images].max()),
            pixel_sigma=options.bundle.pixel_sigma,
        )
        return cls(images, views, options.ransac.max_error)

    def error(self, factor: float) -> float:
        """Median epipolar error, pixels, with focal lengths that are `factor` times those stated."""
        given = self.views
        views = replace(given, plane1=given.plane1 / factor, plane2=given.plane2 / factor, focal=given.focal * factor)
        rays = level_rays(torch.stack((views.plane1, views.plane2)), views.cam_from_level)
        heading, center, valid = relative_pose_npt(rays[0], rays[1], views.index_ratio)
        models = torch.cat((torch.zeros(2, 4, dtype=heading.dtype), heading[:, None], center), dim=-1)[valid]
        if not len(models):
            return self.max_error
        return self._typical(views, refine_in_stages(views, models, self.max_error, STAGES))

    def error_now(self, scene: Scene) -> float:
        """The same with the poses of a reconstruction."""
        if not bool(scene.views.registered[self.images].all()):
            return self.max_error
        first, second = scene.views.center[self.images]
        across = second - first * first.new_tensor((1.0, 1.0, 0.0))
        views = replace(self.views, cam_from_level=scene.views.rotation[self.images], height=float(first[2]))
        return self._typical(views, torch.cat((first.new_zeros(5), across))[None])

    def _typical(self, views: TwoViews, models: Float[Tensor, "h 8"]) -> float:
        """Median error of the best of some models."""
        square = views.squared_errors(models).median(dim=-1).values
        return min(float(square.min().sqrt()), self.max_error)


def _best_pairs(
    matches: Sequence[PairMatches],
    stated: Capture,
    features: Sequence[Features],
    index_ratio: Float[Tensor, ""],
    options: SfmOptions,
) -> list[_Pair]:
    """A few of those with most matches."""
    best = sorted((pair for pair in matches if len(pair) >= options.min_pair_inliers), key=len, reverse=True)
    tried = [_Pair.of(stated, pair, features, index_ratio, options) for pair in best[:PAIRS]]
    return [pair for pair in tried if len(pair.views) >= options.min_pair_inliers]


def _steps(reach: int) -> Float[Tensor, " steps"]:
    return torch.arange(-reach, reach + 1, dtype=torch.float64)


def _refined(pairs: Sequence[_Pair], rough: float) -> tuple[float, Float[Tensor, " pairs"]]:
    """`_best` within a coarse step of a logarithm."""
    return _best(pairs, rough + COARSE / PARTS * _steps(PARTS))


def _best(pairs: Sequence[_Pair], logarithms: Float[Tensor, " k"]) -> tuple[float, Float[Tensor, " pairs"]]:
    """The logarithm of a factor with which all pairs agree best, and that of each pair alone."""
    factors = logarithms.exp().tolist()
    errors = torch.tensor([[pair.error(factor) for factor in factors] for pair in pairs])
    return float(logarithms[errors.square().mean(dim=0).argmin()]), logarithms[errors.argmin(dim=1)]
