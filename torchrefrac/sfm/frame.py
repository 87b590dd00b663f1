"""Where the finished reconstruction stands: what images leave open is fixed by convention and measured heights."""

from dataclasses import replace

import torch
from torch import Tensor

from torchrefrac.geometry import Similarity, heading_rotation, level_rotation, split_heading
from torchrefrac.scene import Capture
from torchrefrac.sfm.model import SparseModel


def fix_frame(model: SparseModel, capture: Capture) -> SparseModel:
    """Put the first registered image at x = y = 0 with heading 0, and scale to the measured heights.

    Through water the scale is the least-squares one of the measured camera heights (or makes the first height 1); plane
    and vertical stay. Without refraction neither can be seen: the frame is levelled by the mean of the gravity
    vectors, the first camera put at its height (or 1), and the scale left as it is.
    """
    images = model.registered.nonzero()[:, 0]
    if not len(images):
        return model
    refractive = bool(model.index_ratio > 1.0)
    level = torch.eye(3, dtype=torch.float64) if refractive else _level(model, capture, images)
    first = images[0]
    _, heading = split_heading(model.rotation[first] @ level.T)
    rotation = heading_rotation(heading) @ level
    center = model.center[images] @ rotation.T
    measured = capture.has_height[images]
    scale, lift = torch.ones((), dtype=torch.float64), torch.zeros((), dtype=torch.float64)
    if refractive:
        found, wanted = center[measured, 2], capture.height[images][measured]
        scale = (found * wanted).sum() / (found * found).sum() if bool(measured.any()) else 1.0 / center[0, 2]
    else:
        lift = torch.where(measured[0], capture.height[first], 1.0) - center[0, 2]
    shift = torch.stack((-center[0, 0], -center[0, 1], lift))
    return _transform(model, Similarity(scale, rotation, scale * shift))


def _level(model: SparseModel, capture: Capture, images: Tensor) -> Tensor:
    """Rotation of the world that takes the mean measured gravity to (0, 0, -1): the shortest, after half a turn about x
    where the world stands on its head.
    """
    down = (model.rotation[images].mT @ capture.down_in_cam[images][..., None])[..., 0].mean(dim=0)
    flip = down.new_tensor((1.0, -1.0, -1.0))
    turn = torch.where(down[2] > 0.0, flip, flip.abs())
    return level_rotation(flip * turn * down / down.norm()).mT * (flip * turn)


def _transform(model: SparseModel, change: Similarity) -> SparseModel:
    registered = model.registered[:, None]
    return replace(
        model,
        rotation=torch.where(registered[..., None], change.apply_to_rotation(model.rotation), model.rotation),
        center=torch.where(registered, change.apply(model.center), model.center),
        points=change.apply(model.points),
    )
