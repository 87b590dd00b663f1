"""A dense surface as one would see it: in its own colours, and as bare relief."""

import math
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from torchrefrac.dense.relief import sun
from torchrefrac.figures.panels import TO_FRONT_DEG, TURN_DEG, from_side, oblique, scale_bar
from torchrefrac.figures.plotting import blank_figure, save
from torchrefrac.figures.side_views import PANEL_INCHES
from torchrefrac.figures.splats import Window, splat
from torchrefrac.geometry import Similarity
from torchrefrac.numerics import thin
from torchrefrac.scene import DenseCloud, Truth
from torchrefrac.scene.wording import Wording

MOST = 500_000  # points
PIXELS, FINER = 760, 2  # of a panel's longer side, and how many times that the discs are drawn
TAIL, MARGIN = 0.001, 0.04  # of stray points, and about the others
NEIGHBOURS, SAMPLE, OVERLAP = 4, 20_000, 1.3  # a disc reaches so many times as far as the fourth nearest other
RISE_DEG = 42.0  # from where it is seen, above the horizontal
LARGEST = 15  # disc, its radius in fine pixels
CLAY, AMBIENT = (0.86, 0.84, 0.80), 0.3


def draw_surface_view(
    cloud: DenseCloud, aligned: Similarity | None, truth: Truth | None, words: Wording, path: Path
) -> None:
    """Draw a dense cloud obliquely from above, or from the front, twice side by side: in the colours of the
    photographs, and lit from the north-west (before a wall from the upper left), as if it were all of one colour.

    `aligned` maps the cloud's frame to that of the truth, in which both are drawn.
    """
    rows = thin(torch.arange(len(cloud)), MOST)
    points, normals, colors = cloud.points[rows], cloud.normals[rows], cloud.colors[rows] / 255.0
    if aligned is not None:
        points, normals = aligned.apply(points), normals @ aligned.rotation.mT
    side = from_side(truth, words)
    frame = oblique(side, TO_FRONT_DEG) if words.is_wall else oblique(side, TURN_DEG, RISE_DEG)
    seen = points @ frame.mT
    window = _window(seen)
    values = torch.cat((colors, _lit(normals, words)[:, None] * seen.new_tensor(CLAY)), dim=-1)
    place, normals, values = (part.float() for part in (seen, normals @ frame.mT, values))
    found, covered = splat(place, normals, values, _radius(points, window), window)
    picture = _coarser(torch.where(covered[..., None], found, 1.0))
    x = (window.left, window.left + window.columns * window.size)
    y = (window.top - window.rows * window.size, window.top)
    figure = blank_figure(0.3 + 2.0 * PANEL_INCHES, 0.5 + PANEL_INCHES * window.rows / window.columns)
    light = "from the upper left" if words.is_wall else "from the north-west"
    titles = "in the colours of the photographs", f"lit {light}"
    for panel, title, shown in zip(figure.subplots(1, 2), titles, picture.split(3, dim=-1), strict=True):
        panel.imshow(shown.numpy(), extent=(*x, *y), interpolation="antialiased")
        scale_bar(panel, x, y, cloud.length_unit)
        panel.set_title(title, fontsize=11)
    save(figure, path, bbox_inches="tight", pad_inches=0.06)


def _window(seen: Float[Tensor, "n 3"]) -> Window:
    """That holds all but stray points, in fine pixels."""
    low, high = seen[:, :2].quantile(seen.new_tensor((TAIL, 1.0 - TAIL)), dim=0)
    margin = MARGIN * (high - low).max()
    (left, bottom), (right, top) = (low - margin).tolist(), (high + margin).tolist()
    size = max(right - left, top - bottom, 1e-9) / (PIXELS * FINER)
    rows, columns = (FINER * max(1, math.ceil(side / size / FINER)) for side in (top - bottom, right - left))
    return Window(left, top, size, rows, columns)


def _radius(points: Float[Tensor, "n 3"], window: Window) -> float:
    """Of discs: so large that they leave no holes in a sheet of points, at least a pixel, and at most LARGEST."""
    return min(max(OVERLAP * _spacing(points), window.size), LARGEST * window.size)


def _spacing(points: Float[Tensor, "n 3"]) -> float:
    """How far the NEIGHBOURS-th nearest other is from a point, median."""
    from scipy.spatial import KDTree  # noqa: PLC0415 - slow to import

    count = min(NEIGHBOURS, len(points) - 1)
    if count < 1:
        return 0.0
    tree = KDTree(points.numpy(), balanced_tree=False, compact_nodes=False)
    distance, _ = tree.query(thin(points, SAMPLE).numpy(), k=count + 1)
    return float(torch.as_tensor(distance)[:, -1].median())


def _lit(normals: Float[Tensor, "n 3"], words: Wording) -> Float[Tensor, " n"]:
    """How bright a surface is: Lambert's law, and light from everywhere."""
    east, north, up = sun()
    light = normals.new_tensor((east, up, north) if words.is_wall else (east, north, up))
    return AMBIENT + (1.0 - AMBIENT) * (normals @ light).clamp(0.0, 1.0)


def _coarser(picture: Float[Tensor, "rows columns k"]) -> Float[Tensor, "r c k"]:
    """Means over squares of FINER pixels a side."""
    return picture.unflatten(1, (-1, FINER)).unflatten(0, (-1, FINER)).mean(dim=(1, 3))
