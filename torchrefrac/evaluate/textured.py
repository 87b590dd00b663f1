"""True points that photographs show well enough to be found."""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor

from torchrefrac.files.photographs import read_grey
from torchrefrac.files.truth import load_truth_points
from torchrefrac.scene import CaptureError, Scene, Truth, TruthPoints

SAME_PLACE = 1.5  # times the distance between neighbouring entries: two images' entries of one place are nearer


def points_to_be_found(truth: Truth, scene: Scene) -> Float[Tensor, "n 3"] | None:
    """True points that the photographs of a scene show well; None where nobody knows them.

    Raises CaptureError where the file of true points does not fit the photographs.
    """
    if truth.folder is None or scene.capture is None:
        return None
    known = load_truth_points(truth.folder, scene.views.names)
    if known is None:
        return None
    paths = dict(zip(scene.capture.names, scene.capture.paths, strict=True))
    try:
        return textured_points(known, [torch.from_numpy(read_grey(paths[name])) for name in known.names])
    except ValueError as error:
        raise CaptureError(f"{truth.folder / 'truth_points.npz'}: {error}") from None


def textured_points(
    truth_points: TruthPoints,
    images: Sequence[Shaped[Tensor, "height width"]],
    min_views: int = 3,
    min_contrast: float = 2.0,
    window: int = 11,
) -> Float[Tensor, "k 3"]:
    """True points that a reconstruction should contain: seen by `min_views` images and textured.

    images: grey values from 0 to 255, one for each name of `truth_points`. A point is textured where the grey
    values of the window x window pixels around its pixel, in the image it belongs to, have a standard deviation of at
    least min_contrast. Another image sees it too where one of that image's own true points lies within 1.5 times the
    distance between neighbouring ones there: this asks no camera model. A place may come from several images.
    Raises ValueError where the images are not those of the points, or `window` is even.
    """
    if len(images) != len(truth_points.names):
        raise ValueError(f"images are {len(images)}, but truth_points is of {len(truth_points.names)} images")
    if window < 1 or window % 2 == 0:
        raise ValueError(f"window is {window}, but must be odd, so that it has a middle")
    if not images:
        return torch.zeros(0, 3, dtype=torch.float64)
    pixels, valid = truth_points.pixels(), truth_points.valid
    contrast = torch.stack([_contrast(image, pixels, own, window) for image, own in zip(images, valid, strict=True)])
    textured = truth_points.valid & (contrast >= min_contrast)
    points = [table[chosen].numpy() for table, chosen in zip(truth_points.points, textured, strict=True)]
    views = _count_views(points, truth_points, min_views)
    return torch.from_numpy(np.concatenate([p[v >= min_views] for p, v in zip(points, views, strict=True)]))


def _contrast(
    image: Shaped[Tensor, "height width"], pixels: Float[Tensor, "h w 2"], valid: Bool[Tensor, "h w"], window: int
) -> Float[Tensor, "h w"]:
    """Standard deviation of an image in the window around each of the valid pixels, cut at the border."""
    contrast = torch.zeros(valid.shape, dtype=torch.float64)
    if not bool(valid.any()):
        return contrast
    column, row = pixels[valid].floor().long().unbind(dim=-1)
    height, width = image.shape
    if min(column.min(), row.min()) < 0 or column.max() >= width or row.max() >= height:
        wants = f"{int(column.max()) + 1} x {int(row.max()) + 1}"
        raise ValueError(f"image is {width} x {height} pixels, but the true points need at least {wants}")
    grey = image.double()
    grey = grey - grey.mean()
    mean, square = _window_mean(grey, window)[row, column], _window_mean(grey.square(), window)[row, column]
    contrast[valid] = (square - mean.square()).clamp(min=0.0).sqrt()
    return contrast


def _window_mean(image: Float[Tensor, "h w"], window: int) -> Float[Tensor, "h w"]:
    """Mean over the pixels of the image that lie in the window around each."""
    for kernel in ((window, 1), (1, window)):
        padding = (kernel[0] // 2, kernel[1] // 2)
        image = torch.nn.functional.avg_pool2d(image[None], kernel, 1, padding, count_include_pad=False)[0]
    return image


def _count_views(
    points: Sequence[Float[np.ndarray, "_ 3"]], truth_points: TruthPoints, enough: int
) -> list[Int[np.ndarray, " _"]]:
    """By how many images each of the points of image i is seen; counted no further than to `enough`."""
    from scipy.spatial import KDTree  # noqa: PLC0415 - slow to import

    entries = [table[valid].numpy() for table, valid in zip(truth_points.points, truth_points.valid, strict=True)]
    trees = [KDTree(table, balanced_tree=False, compact_nodes=False) for table in entries]
    reach = [
        np.append(SAME_PLACE * _spacing(table, valid)[valid].numpy(), 0.0)  # the last is that of a query without answer
        for table, valid in zip(truth_points.points, truth_points.valid, strict=True)
    ]
    views = [np.ones(len(own), dtype=np.int64) for own in points]
    count = len(points)
    for shift in sorted(range(1, count), key=lambda shift: min(shift, count - shift)):  # images nearby see most
        for image in range(count):
            other = (image + shift) % count
            rows = np.flatnonzero(views[image] < enough)
            gap, nearest = trees[other].query(points[image][rows], distance_upper_bound=reach[other].max(), workers=1)
            views[image][rows] += gap < reach[other][nearest]
    return views


def _spacing(points: Float[Tensor, "h w 3"], valid: Bool[Tensor, "h w"]) -> Float[Tensor, "h w"]:
    """Distance between neighbouring points of a grid; 0 where a point has no neighbour.

    The longer of two: that to the nearer neighbour in the row, and that to the nearer one in the column.
    """
    gaps = _to_nearer_neighbour(points, valid), _to_nearer_neighbour(points.transpose(0, 1), valid.T).T
    return torch.maximum(*(torch.where(gap.isfinite(), gap, 0.0) for gap in gaps))


def _to_nearer_neighbour(points: Float[Tensor, "h w 3"], valid: Bool[Tensor, "h w"]) -> Float[Tensor, "h w"]:
    """Distance of points to the nearer of their two neighbours in the row; infinite without one."""
    gap = (points[:, 1:] - points[:, :-1]).norm(dim=-1)
    gap = torch.where(valid[:, 1:] & valid[:, :-1], gap, torch.inf)
    padded = torch.nn.functional.pad(gap, (1, 1), value=torch.inf)
    return torch.minimum(padded[:, 1:], padded[:, :-1])
