"""Which points below the water's level are seen straight, as there is no water before them: a table around a tank, land
beyond the bank. The observations of a track tell where their rays meet better, in water or in air.

In both media the rays of one camera stay in their vertical planes, so that a point which is wrongly taken for one under
water lies beneath its true place, about n times as deep; beyond that, near the vertical, the media differ by little.
What one track leaves open its neighbours decide.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree
from torch import Tensor

from torchrefrac.geometry import Similarity
from torchrefrac.numerics import segment_sum, thin
from torchrefrac.refinement import refine_points
from torchrefrac.scene import Scene, WaterExtent, reprojection_errors
from torchrefrac.sfm.rays import Tracks
from torchrefrac.sfm.rules import Rules

TAIL = 4.0
"""Degrees of freedom of Student's distribution, which the errors of keypoints follow better than the normal one."""
CLEAR = 10.0
"""Twice the logarithm of a likelihood ratio that leaves no doubt; the evidence of neighbours counts up to as much."""
DECIDED = 5.0
"""What the evidence of a track and that of its neighbours must come to, for it to be seen straight."""
NEIGHBOURS = 16
ENOUGH_VIEWS = 3
"""Two rays meet in either medium: tracks of two views decide nothing, but follow their neighbours."""
FEWEST, LEAST_SHARE = 20, 5e-3
"""Clear tracks, and their share of all, below which they are mistakes of matching, and nothing is seen straight."""
LEAST_WATER = 0.02
"""Share of clear tracks that must speak for water: where hardly any does there is none, whatever was stated."""
FINEST_PX, MOST_STEPS = 1e-3, 40
SAMPLE = 500  # of doubtful tracks, which show whether it is worth while to look at all


@dataclass(frozen=True, eq=False)
class Evidence:
    """Of tracks with the points `ids`: twice the logarithm of how much likelier each is seen straight than through
    water, at which places (x, y), and of how many views it is. Zero where it does not lie below the surface."""

    ids: Int[Tensor, " l"]
    ratio: Float[Tensor, " l"]
    place: Float[Tensor, "l 2"]
    views: Int[Tensor, " l"]

    @property
    def clear(self) -> Bool[Tensor, " l"]:
        """Which tracks are seen straight beyond doubt, whatever their neighbours are."""
        return (self.views >= ENOUGH_VIEWS) & (self.ratio > CLEAR + DECIDED)

    @property
    def clearly_wet(self) -> Bool[Tensor, " l"]:
        """Which tracks are seen through water beyond doubt."""
        return (self.views >= ENOUGH_VIEWS) & (self.ratio < -CLEAR - DECIDED)

    def notable(self, tracks: int, share: float = 1.0) -> bool:
        """Whether more of them are clear than mistakes would be among so many tracks; they are a share of all that may
        be clear."""
        return int(self.clear.sum()) >= share * max(FEWEST, LEAST_SHARE * tracks)

    def dry(self, stated: Int[Tensor, " l"]) -> Bool[Tensor, " l"]:
        """Which are seen straight: by themselves, with their neighbours' evidence, or as is stated (1: straight, -1:
        through water, 0: nothing) unless a track of several views is clear against it."""
        own = torch.where(self.views >= ENOUGH_VIEWS, self.ratio, self.ratio.clamp(-CLEAR, CLEAR))
        own = own + (CLEAR + DECIDED) * stated
        known = own.clamp(-CLEAR, CLEAR)
        count = min(NEIGHBOURS, len(known) - 1)
        if count < 1:
            return own > DECIDED
        place = self.place.cpu().numpy()
        _, near = (torch.as_tensor(found) for found in KDTree(place).query(place, count + 1))
        around = known[near[:, 1:].to(known.device)].mean(dim=1)  # the first is the track itself
        return torch.where(stated != 0, own > 0.0, own + around > DECIDED)


def find_dry(scene: Scene, rules: Rules, stated: Int[Tensor, " n"] | None = None) -> Bool[Tensor, " n"] | None:
    """Which points are seen straight though they lie below the surface; None where nothing speaks for any.

    All tracks that two registered views see are judged, placed or not, whatever the scene takes them for. Poses and
    water must be nearly right. stated: see `stated_sides`. Where nothing is, None also if next to no track speaks for
    water: then its index ratio, or that there is water at all, is in doubt, and not where it ends.
    """
    if not scene.interfaces.stand_in_world:
        return None
    length, sigma = scene.sightings(), keypoint_sigma(scene)
    tracks = int((length >= ENOUGH_VIEWS).sum())
    if scene.dry is None and stated is None:
        doubtful = ((length >= ENOUGH_VIEWS) & (_excess(scene, sigma) > CLEAR + DECIDED)).nonzero()[:, 0]
        some = thin(doubtful, SAMPLE)
        wanted = torch.zeros_like(scene.placed).index_fill(0, some, True)
        if not len(some) or not evidence(scene, wanted, rules, sigma).notable(tracks, len(some) / len(doubtful)):
            return None
    found = evidence(scene, length >= 2, rules, sigma)
    if stated is None:
        stated = torch.zeros_like(length)
        clear, wet = int(found.clear.sum()), int(found.clearly_wet.sum())
        if not found.notable(tracks) or wet < LEAST_WATER * (wet + clear):
            return None
    dry = (stated > 0).index_copy(0, found.ids, found.dry(stated[found.ids]))
    return dry if bool(dry.any()) else None


def stated_sides(scene: Scene, extent: WaterExtent, final: Similarity | None) -> Int[Tensor, " n"]:
    """On which side of the stated border of the water each point lies: 1 beyond, -1 within, 0 where that is not known.

    Most photographs in which the border is drawn decide, and where these say nothing the border as seen from above, in
    the frame to which `final` leads (None: that of the scene). Of tracks that are not placed the place is where their
    rays meet in air.
    """
    seen = scene.observations
    sides = extent.all_votes(seen, len(scene.points)).sign()
    if extent.from_above is not None:
        several = scene.sightings() >= 2
        rows = (scene.views.registered[seen.view] & several[seen.point]).nonzero()[:, 0]
        tracks = Tracks.of(replace(scene, dry=torch.ones_like(scene.placed)), rows)
        points, _, _ = tracks.meet()
        from_above = 2 * extent.beyond(points if final is None else final.apply(points)).long() - 1
        sides[tracks.ids] = torch.where(sides[tracks.ids] == 0, from_above, sides[tracks.ids])
    return sides


def disputed(scene: Scene, rules: Rules, stated: Int[Tensor, " n"]) -> tuple[int, int]:
    """How many tracks are clearly seen straight though stated to be under water, and the other way round."""
    if not scene.interfaces.stand_in_world:
        return 0, 0
    found = evidence(scene, scene.sightings() >= ENOUGH_VIEWS, rules, keypoint_sigma(scene))
    sides = stated[found.ids]
    return int((found.clear & (sides < 0)).sum()), int((found.clearly_wet & (sides > 0)).sum())


def with_dry(scene: Scene, dry: Bool[Tensor, " n"] | None) -> Scene:
    """The scene with these points seen straight; those that it took for something else have no place any more."""
    none = torch.zeros_like(scene.placed)
    changed = (none if dry is None else dry) != (none if scene.dry is None else scene.dry)
    accepted = scene.accepted & ~changed[scene.observations.point]
    return replace(scene, dry=dry, placed=scene.placed & ~changed, accepted=accepted)


def same_dry(first: Bool[Tensor, " n"] | None, second: Bool[Tensor, " n"] | None) -> bool:
    """Whether the same points are dry, but for so few that it does not matter."""
    if first is None or second is None:
        return first is second
    return int((first != second).sum()) <= LEAST_SHARE * int(second.sum())


def evidence(scene: Scene, wanted: Bool[Tensor, " n"], rules: Rules, sigma: float) -> Evidence:
    """Of the tracks of points `wanted`, given the noise `sigma` of a keypoint's coordinate, pixels."""
    seen = scene.observations
    rows = (scene.views.registered[seen.view] & wanted[seen.point]).nonzero()[:, 0]
    through_water, straight = (_Fit.of(scene, rows, dry, rules, sigma) for dry in (False, True))
    ratio = torch.where(straight.good & straight.below, through_water.cost - straight.cost, 0.0)
    return Evidence(straight.ids, ratio, straight.points[:, :2], straight.views)


@dataclass(frozen=True, eq=False)
class _Fit:
    """Tracks placed where their observations meet best in one medium: minus twice the logarithms of their likelihoods,
    whether they meet at all, and below the surface."""

    ids: Int[Tensor, " l"]
    points: Float[Tensor, "l 3"]
    cost: Float[Tensor, " l"]
    good: Bool[Tensor, " l"]
    below: Bool[Tensor, " l"]
    views: Int[Tensor, " l"]

    @classmethod
    def of(cls, scene: Scene, rows: Int[Tensor, " k"], dry: bool, rules: Rules, sigma: float) -> "_Fit":
        assumed = replace(scene, dry=torch.ones_like(scene.placed) if dry else None)
        tracks = Tracks.of(assumed, rows)
        cameras, pixels, slot = tracks.cameras, tracks.pixels, tracks.slot
        start, angle, meets = tracks.meet()
        estimate = refine_points(cameras, pixels, slot, start, sigma, rules.bundle.loss_scale, MOST_STEPS)
        error = reprojection_errors(cameras, estimate.points[slot], pixels).clamp(max=rules.max_error)
        return cls(
            ids=tracks.ids,
            points=estimate.points,
            cost=segment_sum(_unlikelihood(error / sigma)[:, None], slot, len(start))[:, 0],
            good=meets & estimate.valid & (angle > rules.min_angle_deg * torch.pi / 180.0),
            below=tracks.height(estimate.points) < 0.0,
            views=torch.bincount(slot, minlength=len(start)),
        )


def keypoint_sigma(scene: Scene) -> float:
    """The scale of the errors of accepted observations, from their median."""
    error = scene.errors()[scene.accepted]
    if not len(error):
        return FINEST_PX
    return max(float(error.median()) / (TAIL * (2.0 ** (2.0 / TAIL) - 1.0)) ** 0.5, FINEST_PX)


def _unlikelihood(error: Float[Tensor, " k"]) -> Float[Tensor, " k"]:
    """Minus twice the logarithm of the likelihood of errors in two coordinates, in units of their scale."""
    return (TAIL + 2.0) * torch.log1p(error.square() / TAIL)


def _excess(scene: Scene, sigma: float) -> Float[Tensor, " n"]:
    """By how much the points, where they are, are unlikelier than is usual; infinite where they have no place."""
    seen, count = scene.observations, len(scene.points)
    rows = scene.views.registered[seen.view]
    cost = _unlikelihood(scene.errors()[rows] / sigma)
    usual = cost[scene.accepted[rows]].median()
    return torch.where(scene.placed, segment_sum((cost - usual)[:, None], seen.point[rows], count)[:, 0], torch.inf)
