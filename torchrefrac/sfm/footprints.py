"""What photographs show of the ground by what is stated of them before anything is matched: positions, gravity, heights
and compass headings.

The ground is taken to be level, and rays to be straight. In water they bend towards the vertical, so that a photograph
shows no more of the bed than straight rays would reach there: what is found here is a safe bound.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchrefrac.geometry import heading_rotation, level_rotation, rotate
from torchrefrac.scene import Capture
from torchrefrac.sfm.walls import looks_through_wall

SIDE = 7
"""Pixels along each side of an image whose rays are followed to the ground."""
DIRECTIONS = 16
"""In which it is known how far a footprint reaches: it is taken for the polygon with so many sides around it."""
DEEPER = 0.25
"""Of its height above the water, by which the bed may lie lower below a camera."""
FARTHEST = 4.0
"""Heights of a camera that it sees aside, at most: beyond, the ground is seen too flat to be recognised."""
TAKE_OFF = "take-off"  # of a georeference whose heights count from there
HEADING_SIGMA = math.radians(5.0)
SIGMAS = 3.0  # standard deviations by which footprints may be larger
GOLDEN = math.pi * (3.0 - math.sqrt(5.0))  # turns by this angle spread evenly over the circle
POSSIBLE = 0.01
"""Times the overlap that counts besides what is stated: that which is possible by what is uncertain."""
NO_OVERLAP = -1.0
BLOCK = 64  # images that are compared with all others at a time


def position_scores(capture: Capture) -> Float[Tensor, "m m"]:
    """How much pairs of images are worth by the stated positions of their cameras, the higher the more.

    Of two images with footprints it is their overlap as positions, gravity and headings are stated, and after that what
    is possible by what is uncertain of these and of the depth; where there is none it is below NO_OVERLAP, by the
    distance of the cameras, the largest being 1. Where one has no footprint, for want of gravity or height, it is above
    NO_OVERLAP and below zero by as much. Minus infinity where a position is not stated.
    """
    known, height = has_position(capture), _heights(capture)
    middle = capture.position[known].mean(dim=0)
    center = torch.where(known[:, None], capture.position, middle)
    nearness = -torch.cdist(center, center)
    nearness = nearness / nearness.abs().amax().clamp(min=1e-12)
    shown = known & capture.down_sigma.isfinite() & (height > 0.0)
    if looks_through_wall(capture) or capture.interfaces.move_with_camera:
        shown = torch.zeros_like(known)
    score, rows = nearness, shown.nonzero()[:, 0]
    if len(rows):
        stated = Footprints.of(capture, height, rows).overlap()
        possible = Footprints.of(capture, (1.0 + DEEPER) * height, rows, SIGMAS).overlap()
        apart = NO_OVERLAP + nearness[rows][:, rows]
        overlap = torch.where(possible + stated > 0.0, stated + POSSIBLE * possible, apart)
        score = score.index_put((rows[:, None], rows), overlap)
    return score.masked_fill(~(known[:, None] & known), -torch.inf)


def has_position(capture: Capture) -> Bool[Tensor, " m"]:
    """Images of which the position is stated."""
    return capture.position_sigma.isfinite().all(dim=-1)


def _heights(capture: Capture) -> Float[Tensor, " m"]:
    """Of cameras above the water: as stated, else by their positions above the level that the stated heights of others
    say; without any above z = 0, unless that is somewhere on a map. Zero where nothing is known."""
    known, stated = has_position(capture), capture.has_height
    z = torch.where(known, capture.position[:, 2], 0.0)
    if bool((known & stated).any()):
        level = (z - capture.height)[known & stated].median()
    elif capture.georeference is None or capture.georeference.vertical == TAKE_OFF:
        level = torch.zeros_like(z[0])
    else:
        return torch.where(stated, capture.height, 0.0)
    return torch.where(stated, capture.height, torch.where(known, z - level, 0.0))


@dataclass(frozen=True, eq=False)
class Footprints:
    """Of each image: points of the ground that it shows, evenly spread over the image; the farthest of them along
    each of DIRECTIONS, with what is uncertain added; and the optical axis."""

    points: Float[Tensor, "m s 2"]
    farthest: Float[Tensor, "m d"]
    axis: Float[Tensor, "m 3"]

    @classmethod
    def of(
        cls, capture: Capture, height: Float[Tensor, " m"], rows: Int[Tensor, " k"], sigmas: float = 0.0
    ) -> "Footprints":
        """Of images `rows` with positions, gravity and a `height` above the ground, larger by so many `sigmas`.
        Without a compass heading an image shows a disc: all that it may show if it is turned about the vertical."""
        turned, height = capture.has_heading[rows], height[rows]
        heading = torch.where(turned, capture.heading[rows], 0.0)
        level = level_rotation(capture.down_in_cam[rows])
        world_from_cam = (level @ heading_rotation(heading)).mT
        rays = rotate(world_from_cam[:, None], _rays(capture, rows))
        aside, down = rays[..., :2], -rays[..., 2]
        length = aside.norm(dim=-1)
        reach = torch.where(down > 0.0, length / down.clamp(min=1e-9), torch.inf).clamp(max=FARTHEST)
        toward = aside / length.clamp(min=1e-12)[..., None]
        any_way = _unit(GOLDEN * torch.arange(rays.shape[1]).to(reach))
        toward = torch.where(turned[:, None, None], toward, any_way)
        center = capture.position[rows, :2]
        offset = height[:, None, None] * reach[..., None] * toward
        most = reach.amax(dim=-1)
        tilt = capture.down_sigma[rows] * (1.0 + most.square())  # by how much the farthest point moves, in heights
        turn = torch.where(turned, HEADING_SIGMA * most, 0.0)
        moved = torch.stack((capture.position_sigma[rows, :2].amax(dim=-1), height * tilt, height * turn))
        farthest = (offset @ _directions(offset).T).amax(dim=1)
        farthest = torch.where(turned[:, None], farthest, (height * most)[:, None])
        axis = torch.where(turned[:, None], world_from_cam[..., 2], rays.new_tensor((0.0, 0.0, -1.0)))
        along = center @ _directions(center).T
        return cls(center[:, None] + offset, along + farthest + sigmas * moved.norm(dim=0)[:, None], axis)

    def overlap(self) -> Float[Tensor, "m m"]:
        """The mean share of either of two images that the other shows, too, less where their optical axes part: half of
        it at a right angle, none of photographs from opposite sides."""
        blocks = (self.points @ _directions(self.points).T).split(BLOCK)
        shares = [(along[:, None] <= self.farthest[:, None]).all(dim=-1).double().mean(dim=-1) for along in blocks]
        share = torch.cat(shares)
        cosine = (self.axis @ self.axis.T).clamp(min=-1.0, max=1.0)
        return 0.25 * (share + share.T) * (1.0 + cosine)


def _rays(capture: Capture, rows: Int[Tensor, " k"]) -> Float[Tensor, "k s 3"]:
    """Directions in camera axes of SIDE x SIDE pixels, those along the border of the image among them."""
    sizes = torch.tensor(capture.cameras.sizes, dtype=torch.float64)[capture.camera[rows]]
    step = torch.linspace(0.0, 1.0, SIDE, dtype=torch.float64)
    pixels = torch.cartesian_prod(step, step) * sizes[:, None]
    plane = capture.cameras.of_views(capture.camera[rows][:, None]).plane_from_pixels(pixels)
    return torch.nn.functional.pad(plane, (0, 1), value=1.0)


def _directions(like: Float[Tensor, "..."]) -> Float[Tensor, "d 2"]:
    """DIRECTIONS of the ground, all around."""
    return _unit(2.0 * math.pi / DIRECTIONS * torch.arange(DIRECTIONS).to(like))


def _unit(angle: Float[Tensor, " d"]) -> Float[Tensor, "d 2"]:
    return torch.stack((angle.cos(), angle.sin()), dim=-1)
