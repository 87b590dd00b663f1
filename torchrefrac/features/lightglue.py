"""Matching by LightGlue (Lindenberger et al., ICCV 2023), a network of kornia."""

import re
from functools import lru_cache
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchrefrac.features.matching import MatchOptions
from torchrefrac.features.networks import CENTER, downloaded, loaded, read_weights
from torchrefrac.features.sift import Features

OLD_NAME = re.compile(r"^(?:matcher\.)?(self|cross)_attn\.(\d+)")
"""How the layers of published weights are called."""
Size = tuple[int, int]


def match_by_lightglue(
    first: Features, second: Features, sizes: tuple[Size, Size], options: MatchOptions, device: torch.device
) -> Int[Tensor, "k 2"]:
    """Index pairs of matching keypoints, ascending in the first column. sizes: width and height of both images, pixels.

    Raises WeightsError where its weights cannot be read or downloaded, or are those of another network.
    """
    if min(len(first), len(second)) < 1:
        return torch.zeros(0, 2, dtype=torch.long, device=device)
    length = first.descriptors.shape[1]
    model = _model(options.trained_on, options.weights, options.made_from, length, device)
    images = {
        f"image{number}": {
            "keypoints": _inside(features, size).to(device),
            "descriptors": features.unit()[None].to(device),
            "image_size": torch.tensor([size], device=device),
        }
        for number, (features, size) in enumerate(zip((first, second), sizes, strict=True))
    }
    with torch.no_grad():
        return model(images)["matches"][0]


def _inside(features: Features, size: Size) -> Float[Tensor, "1 k 2"]:
    """Keypoints by kornia's convention; LightGlue refuses those outside the image."""
    pixels = features.pixels.float() - CENTER
    return torch.minimum(pixels.clamp(min=0.0), pixels.new_tensor(size))[None]


@lru_cache(maxsize=1)
def _model(trained_on: str, weights: str | None, made_from: tuple[str, ...], length: int, device: torch.device) -> Any:
    from kornia.feature import LightGlue  # noqa: PLC0415 - takes seconds to load, and few use it

    if weights is None:
        return downloaded("LightGlue", "matching.weights", lambda: LightGlue(trained_on)).to(device)
    state = {OLD_NAME.sub(r"transformers.\2.\1_attn", name): part for name, part in read_weights(weights).items()}
    network = LightGlue(features=None, input_dim=length)  # type: ignore[arg-type]
    return loaded(network, state, weights).to(device)
