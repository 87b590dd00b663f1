"""Whether the gravity that was stated is that which the images show, and what takes its place where it is not.

Before anything is placed: through water, wrong verticals leave fewer matches that agree on a refractive pose than on a
pinhole one, which is wrong everywhere. Images most of whose pairs are like that get the vertical that refraction shows
in their best pairs (see `vertical`). What is wrong by less shows when all views are adjusted together.
"""

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from scipy.special import chdtri
from torch import Tensor

from torchrefrac.features import Features, PairMatches
from torchrefrac.recorder import Recorder
from torchrefrac.scene import Capture, Scene
from torchrefrac.sfm.rules import SfmOptions
from torchrefrac.sfm.unknown_vertical import pinhole_rotation
from torchrefrac.sfm.verification import VerifiedPair
from torchrefrac.sfm.vertical import (
    LEAST_DOWN_SIGMA,
    UnknownVerticalError,
    angle_between,
    best_pairs,
    carry_over,
    image_planes,
    level_capture,
    mean_vertical,
    verticals_of_pairs,
)

FEW_AGREE = 0.8
"""Share of the matches, and of those that a pinhole explains, below which a refractive pose is suspected."""
CHANCE = 0.0027
"""With which any of several right measurements is called wrong: that of three standard deviations."""


def unlikely(count: int, components: int = 2) -> float:
    """Length of an error, in standard deviations of each of its components, that the largest of `count` exceeds with
    the probability CHANCE; those of verticals have two. From the chi-squared distribution."""
    return math.sqrt(float(chdtri(components, CHANCE / max(count, 1))))


def contradicted_gravity(
    scene: Scene, down_in_cam: Float[Tensor, "m 3"], down_sigma: Float[Tensor, " m"]
) -> Bool[Tensor, " m"]:
    """Registered views whose vertical is farther from `down_in_cam` than errors of down_sigma (radians; infinite: not
    known) explain."""
    known = scene.views.registered & down_sigma.isfinite()
    return _off(scene, down_in_cam, down_sigma) > unlikely(int(known.sum()))


def with_common_tilt(scene: Scene, down_sigma: Float[Tensor, " m"]) -> Float[Tensor, " m"]:
    """Errors that verticals may have, radians: those of gravity, and what errors that observations have in common do to
    the registered views of a finished scene, as its assessment says."""
    common, registered = scene.assessment.common_tilt, scene.views.registered
    if common is None:
        return down_sigma
    return torch.hypot(down_sigma, torch.zeros_like(down_sigma).masked_scatter(registered, common))


def worst_gravity(
    scene: Scene, down_in_cam: Float[Tensor, "m 3"], down_sigma: Float[Tensor, " m"]
) -> Bool[Tensor, " m"]:
    """Those of the contradicted ones that cannot be right: what is off by less than half of the largest, in standard
    deviations, may only be pulled along."""
    off = _off(scene, down_in_cam, down_sigma)
    return contradicted_gravity(scene, down_in_cam, down_sigma) & (off > 0.5 * off.max())


def _off(scene: Scene, down_in_cam: Float[Tensor, "m 3"], down_sigma: Float[Tensor, " m"]) -> Float[Tensor, " m"]:
    """Angles between verticals in standard deviations; 0 where one of them is not known."""
    off = angle_between(scene.down_in_cam, down_in_cam) / down_sigma
    return torch.where(scene.views.registered, off, 0.0)


def with_right_gravity(
    capture: Capture,
    matches: Sequence[PairMatches],
    verified: Sequence[VerifiedPair],
    features: Sequence[Features],
    index_ratio: float,
    options: SfmOptions,
    recorder: Recorder,
) -> Capture:
    """The capture with verticals from refraction for the images whose own cannot be right; itself where all can.

    Images that were not suspected, but whose verticals those pairs contradict, become suspects too: wrong verticals can
    agree among themselves. An image whose vertical no pair shows gets that of an image beside it, good to some degrees.
    Where most images are suspect, all get new verticals.
    """
    suspects = suspect_images(capture, matches, verified, features, options)
    usable = sorted((pair for pair in matches if len(pair) >= options.min_pair_inliers), key=len, reverse=True)
    down, sigma = capture.down_in_cam, capture.down_sigma
    doubtful: set[int] = set()
    while suspects != doubtful:
        doubtful = set(suspects)
        if 2 * len(doubtful) > len(capture):
            return _levelled(capture, matches, features, index_ratio, options, recorder)
        concerned = best_pairs([pair for pair in usable if doubtful & {pair.first, pair.second}])
        of, verticals, sigmas, _ = verticals_of_pairs(capture, concerned, features, index_ratio, options, recorder)
        down, sigma = capture.down_in_cam.clone(), capture.down_sigma.clone()
        sigma[list(doubtful)] = torch.inf
        for image in of.unique().tolist():
            shown, found, _ = mean_vertical(verticals[of == image], sigmas[of == image])
            found = found.clamp(min=LEAST_DOWN_SIGMA)
            apart = angle_between(shown, capture.down_in_cam[image]) / torch.hypot(found, capture.down_sigma[image])
            if image in doubtful:
                down[image], sigma[image] = shown, found
            elif float(apart) > unlikely(len(capture)):
                suspects = suspects | {image}
    if not doubtful:
        return capture
    carry_over(capture, usable, features, options, down, sigma)
    return replace(capture, down_in_cam=down, down_sigma=sigma)


def _levelled(
    capture: Capture,
    matches: Sequence[PairMatches],
    features: Sequence[Features],
    index_ratio: float,
    options: SfmOptions,
    recorder: Recorder,
) -> Capture:
    """With all verticals from refraction; itself where it shows none, and nothing better is known."""
    try:
        return level_capture(capture, matches, features, index_ratio, options, recorder)
    except UnknownVerticalError:
        return capture


def suspect_images(
    capture: Capture,
    matches: Sequence[PairMatches],
    verified: Sequence[VerifiedPair],
    features: Sequence[Features],
    options: SfmOptions,
) -> set[int]:
    """Images most of whose pairs have matches that agree on a pinhole pose, but not on one through the water."""
    agreeing = {(pair.pair.first, pair.pair.second): len(pair.pair) for pair in verified}
    pairs, doubtful = Counter[int](), Counter[int]()
    for pair in matches:
        if len(pair) < options.min_pair_inliers:
            continue
        pairs.update((pair.first, pair.second))
        count = agreeing.get((pair.first, pair.second), 0)
        if count >= FEW_AGREE * len(pair):
            continue
        threshold = options.ransac.max_error / capture.typical_focal(pair.first, pair.second)
        found = pinhole_rotation(*image_planes(capture, features, pair), threshold)
        if found is not None and count < FEW_AGREE * int(found[1].sum()):
            doubtful.update((pair.first, pair.second))
    return {image for image, count in doubtful.items() if 2 * count > pairs[image]}
