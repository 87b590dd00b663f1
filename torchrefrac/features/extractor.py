"""Keypoints of a photograph, by whatever finds them."""

from pathlib import Path
from typing import Protocol, runtime_checkable

from jaxtyping import Bool
from torch import Tensor

from torchrefrac.features.networks import NetworkOptions, extract_by_network, network_of
from torchrefrac.features.sift import Features, SiftOptions, extract_sift
from torchrefrac.numerics import AUTO, device_of


@runtime_checkable
class Extractor(Protocol):
    """Finds and describes keypoints, in place of those methods that the package has.

    It is called in the processes that work is shared among, so that it must be possible to pickle it. Where parts of
    the work are left in a folder it must be a dataclass, by whose fields they are known again.
    """

    def __call__(self, path: Path, used: Bool[Tensor, "height width"] | None = None) -> Features:
        """Keypoints of the image file at `path`, the best first, in pixels whose first has its centre at (0.5, 0.5).

        used: which pixels of the image may be used; None: all. Descriptors have one length in all photographs.
        """
        ...


def extract_features(
    path: Path,
    method: SiftOptions | NetworkOptions | Extractor,
    used: Bool[Tensor, "height width"] | None = None,
    device: str = AUTO,
) -> Features:
    """The keypoints of the image file at `path`.

    used: which of its pixels may be used, by default all. device: where networks run, see `device_of`.
    """
    if isinstance(method, SiftOptions):
        return extract_sift(path, method, used)
    if isinstance(method, NetworkOptions):
        on = device_of(device)
        most, pixels = method.max_features, method.max_pixels
        return extract_by_network(path, network_of(method, on), used, max_features=most, max_pixels=pixels, device=on)
    return method(path, used)
