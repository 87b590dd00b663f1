"""Keypoints of the photographs of a capture, and which of them look alike."""

from collections.abc import Sequence
from functools import lru_cache, partial
from typing import NamedTuple

import numpy as np
import torch

from torchrefrac.commands.pairs import ChosenPairs
from torchrefrac.config import Options
from torchrefrac.features import Features, MatchOptions, PairMatches, SiftOptions, extract_sift, match
from torchrefrac.features.matching import EXHAUSTIVE
from torchrefrac.files.masks import Masks
from torchrefrac.files.work import Arrays, Form, Work
from torchrefrac.numerics import AUTO, device_of
from torchrefrac.recorder import Recorder
from torchrefrac.scene import Capture

KEYPOINTS = Form({"pixels": "f:n2", "colors": "c:n3", "noise": "f:n"}, mapped=("descriptors",))
FIELDS = ("pixels", "descriptors", "colors", "noise")
MATCHES = Form({"count": "i:p", "matches": "i:k2"})
AT_ONCE = 16
"""Pairs that are matched in one part of the work."""
SECONDS_AN_IMAGE, SECONDS_A_PRODUCT = 0.3, 2e-9
"""About how long an image takes, and a pair for each product of two descriptors."""


def extract(capture: Capture, options: Options, recorder: Recorder, work: Work | None = None) -> list[Features]:
    """Keypoints of every photograph, outside its mask."""
    work, masks = work or Work(), Masks(capture)
    sizes = [capture.cameras.sizes[camera] for camera in capture.camera.tolist()]
    how = options.features.for_images(sum(width * height for width, height in sizes) / len(sizes))
    each = [capture.of_views([image]) for image in range(len(capture))]
    made_from = how, capture.paths, masks.paths
    parts = work.parts("features", made_from, partial(_keypoints, how), each, KEYPOINTS, SECONDS_AN_IMAGE)
    found = dict(recorder.track(parts, len(each), "features", "image"))
    return [Features(*(torch.from_numpy(found[image][name]) for name in FIELDS)) for image in range(len(each))]


def _keypoints(options: SiftOptions, photograph: Capture) -> Arrays:
    found = extract_sift(photograph.paths[0], options, Masks(photograph).used(0))
    return {name: getattr(found, name).numpy() for name in FIELDS}


def match_pairs(
    features: Sequence[Features],
    chosen: ChosenPairs,
    options: MatchOptions,
    recorder: Recorder,
    work: Work | None = None,
    device: str = AUTO,
) -> list[PairMatches]:
    """Matches of the pairs that were chosen; device: where descriptors are compared, see `device_of`."""
    if chosen.by != EXHAUSTIVE:
        recorder.note(f"{len(chosen.pairs)} of {chosen.possible} pairs are matched, chosen by {chosen.by}")
    work, pairs = work or Work(), chosen.pairs.tolist()
    jobs = [_Pairs.of(features, pairs[start : start + AT_ONCE]) for start in range(0, len(pairs), AT_ONCE)]
    made_from = options, chosen.pairs, [[of_image.pixels, of_image.descriptors] for of_image in features]
    seconds = AT_ONCE * SECONDS_A_PRODUCT * (sum(map(len, features)) / max(len(features), 1)) ** 2
    found: dict[int, list[PairMatches]] = {}
    with recorder.meter(len(pairs), "matching", "pair") as advance:
        for number, arrays in work.parts(
            "matching", made_from, partial(_matches, options, device), jobs, MATCHES, seconds
        ):
            of_each = torch.from_numpy(arrays["matches"]).split(arrays["count"].tolist())
            done = pairs[number * AT_ONCE : (number + 1) * AT_ONCE]
            found[number] = [PairMatches(i, j, each) for (i, j), each in zip(done, of_each, strict=True)]
            advance(len(done), "")
    return [pair for number in range(len(jobs)) for pair in found[number]]


class _Pairs(NamedTuple):
    """Some pairs of photographs, as places in the list of the descriptors of those that they are of."""

    features: tuple[Features, ...]
    places: tuple[tuple[int, int], ...]

    @classmethod
    def of(cls, features: Sequence[Features], pairs: Sequence[Sequence[int]]) -> "_Pairs":
        images = sorted({image for pair in pairs for image in pair})
        place = {image: i for i, image in enumerate(images)}
        return cls(tuple(features[image] for image in images), tuple((place[i], place[j]) for i, j in pairs))


def _matches(options: MatchOptions, device: str, job: _Pairs) -> Arrays:
    """Of pairs that come one after the other, most of which have the first photograph in common."""
    on = device_of(device)
    unit = lru_cache(maxsize=2)(lambda place: job.features[place].unit().to(on))
    found = [match(unit(i), unit(j), options) for i, j in job.places]
    return {"count": np.array([len(one) for one in found]), "matches": torch.cat(found).cpu().numpy()}
