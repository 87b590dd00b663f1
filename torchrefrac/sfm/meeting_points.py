"""Points from rays through any number of water planes, for tracks of any lengths."""

import torch
from torch import Tensor

from torchrefrac.bundle import BundleState, Links, Observations
from torchrefrac.minimal import triangulate
from torchrefrac.refraction import refract_rays


def meeting_points(state: BundleState, links: Links, seen: Observations, count: int) -> Tensor:
    """Points (count, 3) next to all their rays: bent by the water, or straight where these meet above its surface.

    Tracks of one length are a table; there are not many lengths.
    """
    cameras = state.cameras(links, seen.camera)
    in_air = cameras.view_directions(seen.pixels)
    origins, in_water, _ = refract_rays(cameras.center_in_world, in_air, cameras.interface)
    plane = cameras.plane_in_world()
    length = torch.bincount(seen.point, minlength=count)
    first = length.cumsum(dim=0) - length
    points = seen.pixels.new_zeros(count, 3)
    for n in length.unique().tolist():
        ids = (length == n).nonzero()[:, 0]
        rows = first[ids, None] + torch.arange(n)
        wet, _ = triangulate(origins[rows], in_water[rows])
        dry, _ = triangulate(cameras.center_in_world[rows], in_air[rows])
        above = plane.indexed(rows, (len(seen),)).signed_distance(wet[:, None]).mean(dim=-1) >= 0.0
        points[ids] = torch.where(above[:, None], dry, wet)
    return points
