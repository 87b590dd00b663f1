"""Images, points and what connects them, while an existing alignment is adjusted anew."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchrefrac.bundle import BundleState, Links, Observations
from torchrefrac.camera import Intrinsics, RefractiveCamera
from torchrefrac.files.water import Water
from torchrefrac.refinement import refine_points
from torchrefrac.scene import Alignment
from torchrefrac.sfm.meeting_points import meeting_points

SET_ASIDE = 3


@dataclass(frozen=True)
class Selection:
    """What of a block takes part, numbered anew: image (k) and point (p) say what it was."""

    state: BundleState
    links: Links
    seen: Observations
    image: Tensor
    point: Tensor


@dataclass(frozen=True)
class Block:
    """m images, n points and N observations (`seen`, points ascending), of which some take part.

    images (m): those that do. placed (n): points that have a position. active (N): observations that support one.
    least (n): how many of them a point needs.
    """

    state: BundleState
    links: Links
    seen: Observations
    images: Tensor
    placed: Tensor
    active: Tensor
    least: Tensor

    @classmethod
    def of(cls, alignment: Alignment, water: Water, least: Tensor) -> "Block":
        """Everything takes part, and no point has a position: those given are not seen through water."""
        lenses = torch.zeros_like(alignment.lens) if len(alignment.lenses) == 1 else alignment.lens
        index_ratio = torch.tensor(water.index_ratio, dtype=torch.float64)
        return cls(
            state=BundleState(
                alignment.rotation, alignment.center, alignment.points, stacked(alignment.lenses), index_ratio,
                water.normal, water.offset,
            ),
            links=Links(lenses, water.planes_of(alignment.names)),
            seen=Observations(alignment.image, alignment.point, alignment.pixels),
            images=torch.ones(len(alignment), dtype=torch.bool),
            placed=torch.zeros(len(alignment.points), dtype=torch.bool),
            active=torch.ones(len(alignment.image), dtype=torch.bool),
            least=least,
        )  # fmt: skip

    def with_places(self, wanted: Tensor, pixel_sigma: float, loss_scale: float, limit: float | None = None) -> "Block":
        """The points `wanted` (n) where all their observations in the images meet best; not placed where they do not.

        loss_scale: beyond it errors count linearly, as a single wrong observation would spoil a point otherwise. limit:
        the largest error that an observation may have there; all in pixels. While a point has a larger one its worst
        observation is set aside, up to three times and down to two.
        """
        rows = (self.images[self.seen.camera] & wanted[self.seen.point]).nonzero()[:, 0]
        points, placed = self.state.points.clone(), self.placed & ~wanted
        for _ in range(1 if limit is None else 1 + SET_ASIDE):
            rows = rows[torch.bincount(self.seen.point[rows], minlength=len(placed))[self.seen.point[rows]] >= 2]
            if not len(rows):
                break
            ids, point = torch.unique_consecutive(self.seen.point[rows], return_inverse=True)
            seen = Observations(self.seen.camera[rows], point, self.seen.pixels[rows])
            cameras = self.state.cameras(self.links, seen.camera)
            start = meeting_points(self.state, self.links, seen, len(ids))
            found = refine_points(cameras, seen.pixels, point, start, pixel_sigma, loss_scale)
            error = _distance(cameras, found.points[point], seen.pixels)
            worst = error.new_zeros(len(ids)).scatter_reduce(0, point, error, "amax")
            good = found.valid if limit is None else found.valid & (worst < limit)
            points[ids[good]], placed[ids[good]] = found.points[good], True
            rows = rows[~good[point] & (error < worst[point])]
        return replace(self, state=replace(self.state, points=points), placed=placed)

    def errors(self) -> Tensor:
        """Reprojection error (N) in pixels; inf where the point has no position or no projection, or the image takes no
        part."""
        error = self.seen.pixels.new_full((len(self.seen),), torch.inf)
        rows = (self.placed[self.seen.point] & self.images[self.seen.camera]).nonzero()[:, 0]
        seen = self.seen[rows]
        error[rows] = _distance(self.state.cameras(self.links, seen.camera), self.state.points[seen.point], seen.pixels)
        return error

    def doubtful(self, limit: float) -> Tensor:
        """Points (n) without a position, or with an error above the limit in an image that takes part."""
        beyond = self.images[self.seen.camera] & (self.errors() >= limit)
        return ~self.placed | (torch.bincount(self.seen.point[beyond], minlength=len(self.placed)) > 0)

    def within(self, limit: float, min_support: int = 0) -> "Block":
        """With the observations whose error is below the limit, the points that have enough of them, and the images
        that see at least min_support of these."""
        block = replace(self, active=self.errors() < limit)
        while True:
            count = torch.bincount(block.seen.point[block.active], minlength=len(block.placed))
            placed = block.placed & (count >= block.least)
            active = block.active & placed[block.seen.point]
            support = torch.bincount(block.seen.camera[active], minlength=len(block.images))
            images = block.images & (support >= min_support)
            block = replace(block, images=images, placed=placed, active=active & images[block.seen.camera])
            if bool(block.active.sum() == active.sum()):
                return block

    def above_water(self) -> Tensor:
        """Points (n) above the plane that the first image with an observation of them looks through."""
        first = torch.searchsorted(self.seen.point, torch.arange(len(self.placed))).clamp(max=len(self.seen) - 1)
        normal, offset = (value[self.links.plane[self.seen.camera[first]]] for value in self.state.planes)
        return (normal * self.state.points).sum(dim=-1) > offset

    def same_parts_as(self, other: "Block") -> bool:
        """Whether the same images, points and observations take part."""
        return all(
            torch.equal(mine, its)
            for mine, its in ((self.images, other.images), (self.placed, other.placed), (self.active, other.active))
        )

    def shared(self) -> Selection:
        """What takes part, but for points that a single image sees."""
        active = self.active & self.placed[self.seen.point]
        several = torch.bincount(self.seen.point[active], minlength=len(self.placed)) >= 2
        return replace(self, placed=self.placed & several).select()

    def select(self) -> Selection:
        """What takes part."""
        rows = (self.active & self.placed[self.seen.point]).nonzero()[:, 0]
        image = self.images.nonzero()[:, 0]
        ids, point = torch.unique_consecutive(self.seen.point[rows], return_inverse=True)
        slot = self.images.long().cumsum(dim=0) - 1
        state = replace(
            self.state,
            rotation=self.state.rotation[image],
            center=self.state.center[image],
            points=self.state.points[ids],
        )
        links = Links(self.links.lens[image], self.links.plane[image])
        seen = Observations(slot[self.seen.camera[rows]], point, self.seen.pixels[rows])
        return Selection(state, links, seen, image, ids)

    def with_state(self, adjusted: BundleState, selection: Selection) -> "Block":
        """What took part is as it was adjusted."""
        state = replace(
            adjusted,
            rotation=self.state.rotation.index_copy(0, selection.image, adjusted.rotation),
            center=self.state.center.index_copy(0, selection.image, adjusted.center),
            points=self.state.points.index_copy(0, selection.point, adjusted.points),
        )
        return replace(self, state=state)


def stacked(lenses: Sequence[Intrinsics]) -> Intrinsics:
    """One lens as it is, several as a batch; the size of the image is then that of the first."""
    if len(lenses) == 1:
        return lenses[0]
    return replace(
        lenses[0],
        focal=torch.stack([lens.focal for lens in lenses]),
        principal_point=torch.stack([lens.principal_point for lens in lenses]),
        distortion=torch.stack([lens.distortion for lens in lenses]),
    )


def unstacked(lens: Intrinsics, like: Sequence[Intrinsics]) -> tuple[Intrinsics, ...]:
    """The lenses of `stacked`, each with its own size of the image."""
    values = (lens.focal.reshape(-1, 2), lens.principal_point.reshape(-1, 2), lens.distortion.reshape(-1, 5))
    return tuple(
        replace(own, focal=focal, principal_point=middle, distortion=distortion, check=False)
        for own, focal, middle, distortion in zip(like, *values, strict=True)
    )


def _distance(cameras: RefractiveCamera, points: Tensor, pixels: Tensor) -> Tensor:
    """In the image, between points (N) and pixels (N, 2); inf where a point cannot be seen."""
    projected, possible = cameras.project(points)
    return torch.where(possible, (projected - pixels).norm(dim=-1), torch.inf)
