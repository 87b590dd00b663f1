"""Which of many points a view may show, without a look at each: by clusters of points that are near each other."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchrefrac.camera import Intrinsics, RefractiveCamera
from torchrefrac.numerics import morton_code
from torchrefrac.scene import Scene

SIZE = 16
"""Points of a cluster."""
REACH = 2.0
"""Times the angle under which a cluster is seen straight, by which water may spread it."""
NARROW = 0.125
"""Radians: clusters that are seen under a larger angle may always be in sight."""
BORDER = 9  # places along each side of an image that are followed


@dataclass(frozen=True, eq=False)
class Clusters:
    """The placed points of a scene in clusters: `point` of each, the last one of all repeated to fill up, and how far
    (radius) any of a cluster is from the one in its middle."""

    scene: Scene
    point: Int[Tensor, "p size"]
    radius: Float[Tensor, " p"]

    @classmethod
    def of(cls, scene: Scene) -> "Clusters":
        """Of a scene, of which the poses may be anything."""
        placed = scene.placed.nonzero()[:, 0]
        placed = placed[morton_code(scene.points[placed]).argsort(stable=True)]
        filled = torch.cat((placed, placed[-1:].expand(-len(placed) % SIZE))).view(-1, SIZE)
        places = scene.points[filled]
        return cls(scene, filled, (places - places[:, SIZE // 2, None]).norm(dim=-1).amax(dim=-1))

    def before(self, view: int) -> Bool[Tensor, " n"]:
        """Points that a registered view may show: all that lie in its image are among them. Where some points are dry,
        which are seen elsewhere than their neighbours, these are all that are placed."""
        scene = self.scene
        if scene.dry is not None or not len(self.point):
            return scene.placed.clone()
        camera = scene.camera_of(view)
        middle = scene.points[self.point[:, SIZE // 2]]
        angle = self.radius / (middle - camera.center_in_world).norm(dim=-1)
        low, high = _border(camera.intrinsics)
        ideal = Intrinsics.create(1, 1, 1.0, (0.0, 0.0))
        pose = camera.cam_from_world_rotation, camera.center_in_world
        at, valid = RefractiveCamera(ideal, *pose, camera.interface, check=False).project(middle)
        spread = 1.0 + torch.maximum(low.abs(), high.abs()).square().sum()  # tangents grow so with the angle
        margin = (REACH * spread * angle)[:, None]
        outside = ~valid | (at < low - margin).any(dim=-1) | (at > high + margin).any(dim=-1)
        may = ~outside | ~(angle < NARROW)
        return torch.zeros_like(scene.placed).index_fill(0, self.point[may].flatten(), True)


def _border(intrinsics: Intrinsics) -> tuple[Float[Tensor, "2"], Float[Tensor, "2"]]:
    """Least and largest ideal coordinates of what an image shows."""
    along = torch.linspace(0.0, 1.0, BORDER, dtype=torch.float64)
    both = torch.cartesian_prod(along, along.new_tensor((0.0, 1.0)))
    pixels = torch.cat((both, both.flip(1))) * both.new_tensor((intrinsics.width, intrinsics.height))
    plane = intrinsics.plane_from_pixels(pixels)
    return plane.amin(dim=0), plane.amax(dim=0)
