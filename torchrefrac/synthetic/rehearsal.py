"""A look at a scene before it is photographed: whether there is anything to be seen."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from torchrefrac.camera import Intrinsics
from torchrefrac.synthetic.options import SyntheticOptions
from torchrefrac.synthetic.photograph import Photographer
from torchrefrac.synthetic.stage import StageError

ROWS, COLUMNS = 18, 24
LEAST_SHARE = 0.25
PIXEL_TOLERANCE = 1e-3


def rehearse(photographers: Sequence[Photographer], options: SyntheticOptions, names: Sequence[str]) -> None:
    """Refuse what would make photographs that nobody can use. photographers: who take them in turn.

    Raises StageError, one sentence, where the distortion folds the image over itself, a camera does not stand above the
    water or before the wall, an image sees the scene in less than a quarter of a coarse grid of pixels, or no pixel of
    any image sees anything through the water.
    """
    grids = [_grid(photographer.intrinsics) for photographer in photographers]
    stage, scenery, wet = photographers[0].stage, photographers[0].scenery, 0
    for image, name in enumerate(names):
        photographer, grid = photographers[image % len(photographers)], grids[image % len(photographers)]
        height = float(stage.center[image, 2])
        if not height > scenery.crest and not scenery.is_submerged:
            surface = "above the water, z = 0" if options.at_surface else "before the glass, z = 0"
            surface = surface if scenery.crest == 0.0 else f"above the crests of the waves, z = {scenery.crest:.3g}"
            raise StageError(
                f"scene {options.name}: the camera of {name} stands at z = {height:.4g} {stage.length_unit}, but must "
                f"stand {surface}; raise the camera path"
            )
        sight = photographer.look(image, grid)
        seen = sight.piece >= 0
        share = float(seen.double().mean())
        if share < LEAST_SHARE:
            raise StageError(
                f"scene {options.name}: the camera path leaves the scene, {name} sees it in {share:.0%} of its pixels, "
                f"but must in {LEAST_SHARE:.0%}; shorten the path, lower the cameras, narrow camera.fov_deg, or make "
                "the scene wider"
            )
        wet += int((seen & sight.in_water).sum())
    if wet == 0:
        where, remedy = "above the water", "lower the scene or raise the water"
        if not options.at_surface:
            where, remedy = "before the glass", "move it behind"
        raise StageError(f"scene {options.name} lies {where}: no camera sees anything below z = 0; {remedy}")


def _grid(intrinsics: Intrinsics) -> Float[Tensor, "n 2"]:
    """A coarse grid of pixels, of a lens that shows each point in one place."""
    grid, (width, height) = intrinsics.pixel_grid(ROWS, COLUMNS).flatten(0, 1), (intrinsics.width, intrinsics.height)
    corners = grid.new_tensor([[0.0, 0.0], [width, 0.0], [0.0, height], [width, height]])
    pixels = torch.cat((grid, corners))
    error = (intrinsics.pixels_from_plane(intrinsics.plane_from_pixels(pixels)) - pixels).norm(dim=-1)
    if not bool((error <= PIXEL_TOLERANCE).all()):
        raise StageError(
            f"camera.distortion is {intrinsics.distortion.tolist()}, but such a lens shows a point of the scene at "
            "several places of the image; give smaller coefficients or a smaller camera.fov_deg"
        )
    return grid
