"""Whole images: what a camera would have seen without the interface."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchrefrac.camera.refractive import RefractiveCamera
from torchrefrac.checks import at_least_single, require, require_ending, require_floating


def remove_refraction(
    image: Float[Tensor, "channels height width"],
    camera: RefractiveCamera,
    depth: Float[Tensor, "rows columns"] | Float[Tensor, ""] | float,
    target: RefractiveCamera | None = None,
) -> tuple[Float[Tensor, "channels rows columns"], Bool[Tensor, "rows columns"]]:
    """Resample an image to what `target` would have seen had the scene at `depth` lain in the camera's own medium.

    image: as taken by `camera` (one camera, no batch), whose intrinsics have its size; depth: how far below
    the interface's first surface the scene lies, a number or a map for every pixel
    of the result, in the unit of the scene, above 0. target: a camera without an interface, by default
    `camera.as_pinhole()`; give it intrinsics without distortion to undistort in the same step.

    Returns the image by bilinear interpolation, and a mask of the pixels that `camera` sees; elsewhere the result is 0.
    Exact where the scene lies at `depth`; a point at another depth is moved. Differentiable in the image, the depth and
    the camera. Raises ValueError for a batch of cameras, and for an image or a depth of another size.
    """
    require_ending(image, "image", (camera.intrinsics.height, camera.intrinsics.width))
    if image.dim() != 3:
        raise ValueError(f"image has shape {tuple(image.shape)}, but must be (channels, height, width)")
    if camera.shape:
        raise ValueError(f"camera has batch shape {tuple(camera.shape)}, but must be a single one")
    require_floating(image, "image")
    require(depth, "depth", above=0.0)
    view = camera.as_pinhole() if target is None else target
    if view.shape:
        raise ValueError(f"target has batch shape {tuple(view.shape)}, but must be a single camera")
    size = (view.intrinsics.height, view.intrinsics.width)
    if isinstance(depth, Tensor) and depth.dim() and depth.shape != size:
        raise ValueError(f"depth has shape {tuple(depth.shape)}, but must be a number or a map of the target's {size}")
    points, met = _points_at_depth(view, camera, depth)
    pixels, seen = camera.project(points, inside_image=True)
    image = at_least_single(image)
    x, y = pixels.unbind(dim=-1)
    grid = torch.stack((2.0 * x / camera.intrinsics.width - 1.0, 2.0 * y / camera.intrinsics.height - 1.0), dim=-1)
    mask = met & seen
    resampled = torch.nn.functional.grid_sample(
        image[None], grid[None].to(image.dtype), mode="bilinear", padding_mode="border", align_corners=False
    )[0]
    return torch.where(mask, resampled, 0.0), mask


def _points_at_depth(
    view: RefractiveCamera, camera: RefractiveCamera, depth: Float[Tensor, "rows columns"] | Float[Tensor, ""] | float
) -> tuple[Float[Tensor, "rows columns 3"], Bool[Tensor, "rows columns"]]:
    """Where the straight rays of `view` meet the plane `depth` below the interface, and whether they do."""
    plane, center = camera.plane_in_world(), view.center_in_world
    directions = view.view_directions(view.intrinsics.pixel_grid())
    approach = -(plane.normal_like(directions) * directions).sum(dim=-1)
    met = approach > 0
    distance = (plane.signed_distance(center) + depth) / torch.where(met, approach, 1.0)
    return center + distance[..., None] * directions, met
