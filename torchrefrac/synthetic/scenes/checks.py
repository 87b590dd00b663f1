"""Checks that the options of several scenes share."""

from collections.abc import Sequence

from torchrefrac.checks import require, require_between

MAX_IMAGES = 500


def require_images(images: int, name: str = "images", *, at_least: int = 2) -> None:
    """Refuse too few photographs to reconstruct from, and more than anyone means to render."""
    require_between(images, name, at_least, MAX_IMAGES)


def require_heights(heights: Sequence[float]) -> None:
    """Refuse cameras that do not stand above the water."""
    if not heights:
        raise ValueError("heights is empty, but must be one or more heights above the water, taken in turn")
    for height in heights:
        require(height, "heights", above=0.0)
