"""One more image by its absolute pose."""

from dataclasses import replace

import torch
from torch import Tensor

from torchrefrac.sfm.model import SparseModel
from torchrefrac.sfm.options import SfmOptions
from torchrefrac.sfm.pose import PoseInitializer


def visible_points(model: SparseModel) -> Tensor:
    """How many reconstructed points each image sees (m)."""
    seen = model.has_point[model.tracks.track]
    return torch.bincount(model.tracks.image[seen], minlength=len(model.registered))


def register_image(
    model: SparseModel,
    image: int,
    initializer: PoseInitializer,
    options: SfmOptions,
    generator: torch.Generator,
) -> tuple[SparseModel, str]:
    """Register `image` by the points it sees; those that agree with its pose become its observations.

    The second value is empty, or says why it could not be registered and the model is the one given.
    """
    rows = ((model.tracks.image == image) & model.has_point[model.tracks.track]).nonzero()[:, 0]
    needed = options.min_registration_inliers
    if len(rows) < needed:
        return model, f"sees only {len(rows)} reconstructed points, of which a pose needs {needed}"
    points = model.points[model.tracks.track[rows]]
    pose = initializer.absolute(image, model.tracks.pixels[rows], points, generator)
    agreeing = int(pose.inliers.sum()) if pose is not None else 0
    if pose is None or agreeing < needed:
        return model, f"no pose agrees with more than {agreeing} of the {len(rows)} reconstructed points that it sees"
    active = model.active.clone()
    active[rows[pose.inliers]] = True
    return replace(model.with_poses([image], pose.rotation[None], pose.center[None]), active=active), ""
