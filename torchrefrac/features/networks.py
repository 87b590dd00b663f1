"""Keypoints and descriptors by networks: DISK and ALIKED as kornia has them, or any other."""

import math
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.nn.functional import normalize

from torchrefrac.checks import Range, TorchrefracError, require_ranges
from torchrefrac.features.reduced import colors_at, distance_to_unused, nearest_pixels, reduced, reduced_mask
from torchrefrac.features.sift import Features
from torchrefrac.files.fingerprint import fingerprint_of_file
from torchrefrac.files.photographs import read_color

CENTER = 0.5
"""What kornia's pixels, which count from the centre of the first, are less than those here."""
MARGIN = 8.0
"""Pixels from what may not be used, within which keypoints are left out: of an edge that a mask makes or follows."""
RANGES = {
    "max_pixels": Range(at_least=1.0, at_most=1e9),
    "max_features": Range(at_least=1, at_most=10_000_000),
}
Weights = dict[str, Any]


class WeightsError(TorchrefracError, ValueError):
    """The weights of a network are missing, or are not those of this network; the message names the file."""


class Detected(NamedTuple):
    """Keypoints that a network finds in an image.

    pixels: the centre of the first pixel is (0.5, 0.5); descriptors: of any length, the nearer the more alike; scores:
    by which keypoints are chosen, the largest first.
    """

    pixels: Float[Tensor, "k 2"]
    descriptors: Float[Tensor, "k d"]
    scores: Float[Tensor, " k"]


Network = Callable[[Float[Tensor, "3 height width"]], Detected]
"""From an RGB image of values from 0 to 1 to its keypoints, on the device of the image."""


@dataclass(frozen=True)
class NetworkOptions:
    """A network of kornia: DISK (Tyszkiewicz et al., NeurIPS 2020) or ALIKED (Zhao et al., IEEE TIM 2023).

    weights: path of their file, by default those that kornia downloads. max_features: keypoints with the highest
    scores. max_pixels: larger images are reduced to as many, which bounds the memory.

    Raises ValueError for weights that are no file.
    """

    method: Literal["kornia_disk", "kornia_aliked"] = "kornia_disk"
    weights: str | None = None
    max_features: int = 8192
    max_pixels: float = 2e6

    def __post_init__(self) -> None:
        require_ranges(self, RANGES)
        require_file(self.weights)

    @property
    def made_from(self) -> tuple[str, ...]:
        """What is in the files that the options name, as a fingerprint."""
        return content_of(self.weights)


def content_of(weights: str | None) -> tuple[str, ...]:
    """A fingerprint of a file of weights; nothing where kornia downloads them."""
    return () if weights is None else (fingerprint_of_file(Path(weights)),)


def require_file(weights: str | None) -> None:
    """Refuse weights that are no file."""
    if weights is not None and not Path(weights).is_file():
        raise ValueError(f"weights is {weights!r}, but must be a file, or null for those that kornia downloads")


def extract_by_network(
    path: Path,
    network: Network,
    used: Bool[Tensor, "height width"] | None = None,
    *,
    max_features: int = 8192,
    max_pixels: float = 2e6,
    device: torch.device | str = "cpu",
) -> Features:
    """The keypoints that a network finds in the image file at `path`, the best first, with descriptors of length one.

    used: which of its pixels may be used, by default all; no keypoint is within MARGIN pixels of the others.
    max_features: of more keypoints those with the highest scores. max_pixels: a larger image is reduced to as many.
    device: where the network is.
    """
    image, (across, down) = reduced(read_color(path), max_pixels)
    rgb = torch.from_numpy(np.ascontiguousarray(image[..., ::-1])).to(device).permute(2, 0, 1).float() / 255.0
    with torch.no_grad():
        found = Detected(*(part.cpu() for part in network(rgb)))
    pixels = found.pixels.double()
    order = found.scores.argsort(descending=True, stable=True)
    if used is not None:
        rows, columns = image.shape[:2]
        column, row = nearest_pixels(pixels.numpy() - 0.5, rows, columns)
        away = torch.from_numpy(distance_to_unused(reduced_mask(used, rows, columns))[row, column])
        order = order[away[order] > MARGIN]
    order = order[:max_features]
    return Features(
        pixels=pixels[order] * torch.tensor((across, down), dtype=torch.float64),
        descriptors=normalize(found.descriptors[order].float(), dim=1),
        colors=colors_at(image, pixels[order]),
        noise=torch.full((len(order),), math.sqrt(across * down), dtype=torch.float64),
    )


def network_of(options: NetworkOptions, device: torch.device) -> Network:
    """A network of kornia, on a device; the last one is not loaded again until its file changes.

    Raises WeightsError where its weights cannot be read or downloaded, or are those of another network.
    """
    return _network(options.method, options.weights, options.made_from, device)


@lru_cache(maxsize=1)
def _network(method: str, weights: str | None, made_from: tuple[str, ...], device: torch.device) -> Network:
    return (_disk if method == "kornia_disk" else _aliked)(weights, device)


def _disk(weights: str | None, device: torch.device) -> Network:
    from kornia.feature import DISK  # noqa: PLC0415 - takes seconds to load, and few use it

    if weights is None:
        return by_disk(downloaded("DISK", "features.weights", lambda: DISK.from_pretrained("depth", device)))
    state = read_weights(weights)
    return by_disk(loaded(DISK(), state.get("extractor", state), weights).to(device))


def _aliked(weights: str | None, device: torch.device) -> Network:
    from kornia.feature import ALIKED  # noqa: PLC0415

    if weights is None:
        return by_aliked(downloaded("ALIKED", "features.weights", lambda: ALIKED.from_pretrained(device=device)))
    state = read_weights(weights)
    return by_aliked(loaded(ALIKED(_kind_of_aliked(state)), state, weights).to(device))


def by_disk(model: nn.Module) -> Network:
    """What a DISK of kornia detects, at whole pixels of its own. Images are padded to a multiple of 16."""

    def detect(image: Float[Tensor, "3 height width"]) -> Detected:
        (found,) = model(image[None], pad_if_not_divisible=True)
        return Detected(found.keypoints + CENTER, found.descriptors, found.detection_scores)

    return detect


def by_aliked(model: nn.Module) -> Network:
    """What an ALIKED of kornia detects, which pads images itself."""

    def detect(image: Float[Tensor, "3 height width"]) -> Detected:
        (found,) = model(image[None])
        return Detected(found.keypoints + CENTER, found.descriptors, found.keypoint_scores)

    return detect


def _kind_of_aliked(state: Weights) -> str:
    """By how many places a descriptor is made from, and how long it is."""
    places = state.get("desc_head.agg_weights", torch.empty(16, 128, 128))
    if places.shape[-1] == 64:
        return "aliked-t16"
    return "aliked-n32" if len(places) == 32 else "aliked-n16"


def downloaded(name: str, option: str, download: Callable[[], nn.Module]) -> nn.Module:
    """A network with weights that kornia downloads, or has downloaded before.

    Raises WeightsError that names the option where it cannot.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of each source that it tries; the last says enough
            return download().eval()
    except (OSError, RuntimeError) as error:
        reason = str(error).strip().split("\n", maxsplit=1)[0].rpartition("Last error: ")[2][:100].rstrip(".")
        raise WeightsError(
            f"the weights of {name} cannot be downloaded by kornia ({reason}): name a file of them as {option}"
        ) from None


def read_weights(path: str) -> Weights:
    """The tensors of a file that `torch.save` has written. Raises WeightsError for any other."""
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # noqa: BLE001 - of damaged files the reader raises nearly everything
        reason = str(error).strip().split("\n", maxsplit=1)[0][:200].rstrip(".")
        raise WeightsError(f"{path} cannot be read as the weights of a network: {reason}") from None
    if not isinstance(state, Mapping):
        raise WeightsError(f"{path} holds a {type(state).__name__}, but must hold the weights of a network by name")
    return dict(state)


def loaded(model: nn.Module, state: Weights, path: str) -> nn.Module:
    """A network with these weights, ready for use. Raises WeightsError where they are those of another."""
    try:
        lacking = set(model.load_state_dict(state, strict=False).missing_keys) & {
            name for name, _ in model.named_parameters()
        }
    except RuntimeError as error:
        lacking = {str(error).strip().split("\n")[1].strip() if "\n" in str(error) else str(error)}
    if lacking:
        raise WeightsError(f"{path} holds weights of another network than {type(model).__name__}: see {min(lacking)}")
    return model.eval()
