"""The scale that stated camera heights give, where some of them, or what they are counted from, may be wrong.

Through water images fix the heights of the cameras above it but for one scale, so that stated heights check each other.
Heights that a drone counts from where it took off are all wrong by the same, which shows where it flew at several.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

FAR = 3.5
LEAST_FOR_OFFSET = 4


@dataclass(frozen=True, eq=False)
class HeightFit:
    """stated = scale * found + offset, for those heights that agree; offset is 0 unless all but that agree."""

    scale: Float[Tensor, ""]
    offset: Float[Tensor, ""]
    agrees: Bool[Tensor, " k"]


def fit_heights(found: Float[Tensor, " k"], stated: Float[Tensor, " k"], sigma: Float[Tensor, " k"]) -> HeightFit:
    """Heights above the water as they were found, in any unit, and as they were stated, with standard deviations.

    The least-squares scale where all agree within FAR standard deviations; else the scale and offset with which
    LEAST_FOR_OFFSET or more all agree; else the scale of those that agree with their median.
    """
    nothing = torch.zeros_like(stated)
    plain = _fit(found, stated, torch.ones_like(stated))
    if bool(_agree(found, stated, plain, nothing[0], sigma).all()):
        return HeightFit(plain, nothing[0], nothing == 0.0)
    if len(found) >= LEAST_FOR_OFFSET:
        design = torch.stack((found, torch.ones_like(found)), dim=1)
        scale, offset = torch.linalg.lstsq(design, stated[:, None]).solution[:, 0]
        spread = found.std() * scale
        if bool((spread > 2.0 * sigma.mean()) & _agree(found, stated, scale, offset, sigma).all()):
            return HeightFit(scale, offset, nothing == 0.0)
    agrees = _agree(found, stated, (stated / found).median(), nothing[0], sigma)
    return HeightFit(_fit(found, stated, agrees.to(found.dtype)), nothing[0], agrees)


def _fit(found: Float[Tensor, " k"], stated: Float[Tensor, " k"], weight: Float[Tensor, " k"]) -> Float[Tensor, ""]:
    return (weight * found * stated).sum() / (weight * found * found).sum()


def _agree(
    found: Float[Tensor, " k"],
    stated: Float[Tensor, " k"],
    scale: Float[Tensor, ""],
    offset: Float[Tensor, ""],
    sigma: Float[Tensor, " k"],
) -> Bool[Tensor, " k"]:
    return (scale * found + offset - stated).abs() <= FAR * sigma
