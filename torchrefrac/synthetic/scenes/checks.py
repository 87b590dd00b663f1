"""Checks that the options of several scenes share."""

from collections.abc import Sequence

from torchrefrac.checks import require

MAX_IMAGES = 500


def require_images(images: int, name: str = "images", *, at_least: int = 2) -> None:
    """Refuse too few photographs to reconstruct from, and more than anyone means to render."""
    if not at_least <= images <= MAX_IMAGES:
        raise ValueError(f"{name} is {images}, but must lie between {at_least} and {MAX_IMAGES}")


def require_heights(heights: Sequence[float]) -> None:
    """Refuse cameras that do not stand above the water."""
    if not heights:
        raise ValueError("heights is empty, but must be one or more heights above the water, taken in turn")
    for height in heights:
        require(height, "heights", above=0.0)
