"""Which way is down in every image, where nobody measured it: from the refraction in pairs of images.

Each image's best pairs are solved without verticals (see `unknown_vertical`). Those that agree on an image are
averaged with the weights that their uncertainties give; the others are outliers. Where no pair shows it, a pinhole
relative rotation to an image that has its vertical carries it over, good to a few degrees. An image that nothing
relates to the others keeps its optical axis: it cannot be registered either.
"""

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchrefrac.checks import TorchrefracError
from torchrefrac.features import Features, PairMatches
from torchrefrac.geometry import rotate
from torchrefrac.recorder import Recorder
from torchrefrac.scene import Capture
from torchrefrac.sfm.rules import SfmOptions
from torchrefrac.sfm.unknown_vertical import UnknownVertical, find_verticals, pinhole_rotation

PAIRS_PER_IMAGE = 3
LEAST_SIGMA, LEAST_DOWN_SIGMA = math.radians(0.2), math.radians(0.5)
"""Of a vertical from one pair, for what the noise does not tell; and of the capture, because the adjustment will use
the same matches again: a tighter prior counts them twice."""
PINHOLE_SIGMA, VAGUE_SIGMA = math.radians(5.0), math.radians(30.0)
NOISY = 4.0
FAR = 9.0
"""Squared distance in standard deviations at which two verticals of one image contradict each other."""


class UnknownVerticalError(TorchrefracError, RuntimeError):
    """No pair of images shows which way is down."""


def level_capture(
    capture: Capture,
    pairs: Sequence[PairMatches],
    features: Sequence[Features],
    index_ratio: float,
    options: SfmOptions,
    recorder: Recorder,
) -> Capture:
    """The capture with estimated verticals. down_sigma, the same for all images: the root mean square over the images,
    the scatter between the pairs of one image, or LEAST_DOWN_SIGMA, whichever is largest.

    Raises UnknownVerticalError when no pair shows a vertical.
    """
    usable = _usable(pairs, options)
    of, verticals, sigmas, detail = verticals_of_pairs(
        capture, best_pairs(usable), features, index_ratio, options, recorder
    )
    if not len(of):
        raise UnknownVerticalError(
            f"capture.json has no down_in_cam, and which way is down in the images cannot be seen: {detail}; "
            "measure down_in_cam of every image"
        )
    down, sigma = capture.down_in_cam.clone(), torch.full((len(capture),), torch.inf, dtype=torch.float64)
    scatter = torch.zeros(len(capture), dtype=torch.float64)
    for image in of.unique().tolist():
        down[image], sigma[image], scatter[image] = mean_vertical(verticals[of == image], sigmas[of == image])
    carry_over(capture, usable, features, options, down, sigma)
    for image in sigma.isinf().nonzero()[:, 0].tolist():
        recorder.note(f"{capture.names[image]}: no pair relates it to the others, so that its vertical stays unknown")
    known = sigma.isfinite()
    overall = torch.maximum(_rms(sigma[known]), _rms(scatter[of.unique()]))
    sigma = torch.full_like(sigma, max(float(overall), LEAST_DOWN_SIGMA))
    return replace(capture, down_in_cam=down, down_sigma=sigma, has_gravity=True)


def complete_gravity(
    capture: Capture,
    pairs: Sequence[PairMatches],
    features: Sequence[Features],
    index_ratio: float,
    options: SfmOptions,
    recorder: Recorder,
) -> Capture:
    """The capture with a vertical for each image that has none: from the best of its pairs, in descending order, that
    determine theirs, or else from an image beside it, good to some degrees; VAGUE_SIGMA where there is neither."""
    usable = _usable(pairs, options)
    down, sigma = capture.down_in_cam.clone(), capture.down_sigma.clone()
    unknown = set(sigma.isinf().nonzero()[:, 0].tolist())
    concerned = best_pairs([pair for pair in usable if unknown & {pair.first, pair.second}])
    of, verticals, sigmas, _ = verticals_of_pairs(capture, concerned, features, index_ratio, options, recorder)
    for image in unknown & set(of.tolist()):
        down[image], found, _ = mean_vertical(verticals[of == image], sigmas[of == image])
        sigma[image] = found.clamp(min=LEAST_DOWN_SIGMA)
    carry_over(capture, usable, features, options, down, sigma)
    return replace(capture, down_in_cam=down, down_sigma=sigma.clamp(max=VAGUE_SIGMA))


def _usable(pairs: Sequence[PairMatches], options: SfmOptions) -> list[PairMatches]:
    """Those with enough matches, in descending order."""
    return sorted((pair for pair in pairs if len(pair) >= options.min_pair_inliers), key=len, reverse=True)


def best_pairs(pairs: Sequence[PairMatches]) -> list[PairMatches]:
    """Of pairs in descending order those that are among the first PAIRS_PER_IMAGE of one of their images."""
    seen: Counter[int] = Counter()
    chosen = []
    for pair in pairs:
        if min(seen[pair.first], seen[pair.second]) < PAIRS_PER_IMAGE:
            chosen.append(pair)
        seen.update((pair.first, pair.second))
    return chosen


def verticals_of_pairs(
    capture: Capture,
    pairs: Sequence[PairMatches],
    features: Sequence[Features],
    index_ratio: float,
    options: SfmOptions,
    recorder: Recorder,
) -> tuple[Int[Tensor, " e"], Float[Tensor, "e 3"], Float[Tensor, " e"], str]:
    """Both verticals of every pair that determines them: of which image, down_in_cam, and how uncertain in radians; and
    why the first pair that does not fails.

    A pair whose matches fit NOISY times worse than those of another has not found its pose: refinement finds the
    minimum next to its start, and near nadir the right one is narrow.
    """
    solved: list[tuple[PairMatches, UnknownVertical]] = []
    detail = "" if pairs else f"no pair of images has {options.min_pair_inliers} matches"
    for step, pair in enumerate(recorder.track(pairs, len(pairs), "levelling", "pair")):
        limits = options.ransac.max_error, options.min_pair_inliers
        planes = image_planes(capture, features, pair)
        focal = capture.intrinsics_of([pair.first, pair.second]).focal
        found = find_verticals(*planes, focal, index_ratio, *limits)
        recorder.scalar("levelling/inliers", int(found.inliers.sum()), step)
        if found.status == "success":
            solved.append((pair, found))
        elif not detail:
            detail = f"{capture.names[pair.first]} and {capture.names[pair.second]}: {found.detail}"
    least = min((found.noise for _, found in solved), default=0.0)
    right = [(pair, found) for pair, found in solved if found.noise <= NOISY * least]
    image = torch.tensor([i for pair, _ in right for i in (pair.first, pair.second)], dtype=torch.long)
    down = torch.cat([torch.zeros(0, 3, dtype=torch.float64), *(found.down_in_cam for _, found in right)])
    return image, down, torch.cat([down[:0, 0], *(found.sigma for _, found in right)]), detail


def mean_vertical(
    down: Float[Tensor, "k 3"], sigma: Float[Tensor, " k"]
) -> tuple[Float[Tensor, "3"], Float[Tensor, ""], Float[Tensor, ""]]:
    """Mean of the verticals of one image that agree with the one that most agree with, its sigma, and the scatter of
    those about it.

    Where no majority agrees the most certain one is taken, as uncertain as a pinhole leaves it.
    """
    variance = sigma.square() + LEAST_SIGMA**2
    apart = angle_between(down[:, None], down).square() / (variance[:, None] + variance)
    central = (apart.clamp(max=FAR).sum(dim=-1) + 0.1 * variance / variance.amax()).argmin()
    weight = torch.where(apart[central] < FAR, 1.0 / variance, 0.0)
    agreeing, total = int((weight > 0.0).sum()), weight.sum()
    mean = torch.nn.functional.normalize((weight[:, None] * down).sum(dim=0), dim=0)
    spread = (weight * angle_between(down, mean).square()).sum() / total * (agreeing / max(agreeing - 1, 1))
    alone = 2 * agreeing <= len(down)
    return mean, torch.where(torch.tensor(alone), PINHOLE_SIGMA, total.rsqrt()), spread.sqrt()


def carry_over(
    capture: Capture,
    pairs: Sequence[PairMatches],
    features: Sequence[Features],
    options: SfmOptions,
    down: Float[Tensor, "m 3"],
    sigma: Float[Tensor, " m"],
) -> None:
    """Fill in, from image to image, the verticals whose sigma is infinite, by the first pairs that can."""
    left = list(pairs)
    while bridges := [pair for pair in left if sigma[[pair.first, pair.second]].isinf().sum() == 1]:
        pair = bridges[0]
        left.remove(pair)
        threshold = options.ransac.max_error / capture.typical_focal(pair.first, pair.second)
        found = pinhole_rotation(*image_planes(capture, features, pair), threshold)
        if found is None or int(found[1].sum()) < options.min_pair_inliers:
            continue
        known, other, turn = pair.first, pair.second, found[0]
        if bool(sigma[known].isinf()):
            known, other, turn = other, known, turn.mT
        down[other] = rotate(turn, down[known])
        sigma[other] = torch.hypot(sigma[known], torch.as_tensor(PINHOLE_SIGMA, dtype=sigma.dtype))


def image_planes(
    capture: Capture, features: Sequence[Features], pair: PairMatches
) -> tuple[Float[Tensor, "k 2"], Float[Tensor, "k 2"]]:
    """Ideal image coordinates of the matches in both images."""
    images = pair.first, pair.second
    one, two = capture.planes(images, [features[i].pixels[pair.matches[:, k]] for k, i in enumerate(images)])
    return one, two


def angle_between(one: Float[Tensor, "*#batch 3"], two: Float[Tensor, "*#batch 3"]) -> Float[Tensor, "*#batch"]:
    """Angle between unit vectors."""
    one, two = torch.broadcast_tensors(one, two)
    return torch.atan2(torch.linalg.cross(one, two).norm(dim=-1), (one * two).sum(dim=-1))


def _rms(values: Float[Tensor, " k"]) -> Float[Tensor, ""]:
    return values.square().mean().sqrt()
