"""Keypoints of the photographs of a capture, and which of them look alike."""

from collections.abc import Sequence
from functools import lru_cache, partial
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchrefrac.commands.pairs import ChosenPairs
from torchrefrac.config import OptionError, Options
from torchrefrac.features import (
    Extractor,
    Features,
    MadeElsewhereOptions,
    MatchOptions,
    NetworkOptions,
    PairMatches,
    SiftOptions,
    extract_features,
    match,
)
from torchrefrac.features.elsewhere import features_and_matches
from torchrefrac.features.lightglue import match_by_lightglue
from torchrefrac.features.matching import EXHAUSTIVE
from torchrefrac.features.reduced import colors_at, nearest_pixels
from torchrefrac.files.correspondences import read_correspondences
from torchrefrac.files.masks import Masks
from torchrefrac.files.photographs import read_color
from torchrefrac.files.work import Arrays, Form, Work
from torchrefrac.numerics import AUTO, device_of
from torchrefrac.recorder import Recorder
from torchrefrac.scene import Capture

KEYPOINTS = Form({"pixels": "f:n2", "colors": "c:n3", "noise": "f:n"}, mapped=("descriptors",))
COLORS = Form({"used": "b:n", "colors": "c:n3"})
FIELDS = ("pixels", "descriptors", "colors", "noise")
MATCHES = Form({"count": "i:p", "matches": "i:k2"})
AT_ONCE = 16
"""Pairs that are matched in one part of the work."""
SECONDS_AN_IMAGE, SECONDS_A_LOOK, SECONDS_A_PRODUCT = 0.3, 0.05, 2e-9
"""About how long an image takes, one whose keypoints are known, and a pair for each product of two descriptors."""


def extract(capture: Capture, options: Options, recorder: Recorder, work: Work | None = None) -> list[Features]:
    """Keypoints of every photograph, outside its mask. Raises OptionError for those that were made elsewhere."""
    work, masks, how = work or Work(), Masks(capture), options.features
    if isinstance(how, MadeElsewhereOptions):
        raise OptionError(f"features.method is {how.method!r}, by which no keypoints are looked for")
    if isinstance(how, SiftOptions):
        sizes = sizes_of(capture)
        how = how.for_images(sum(width * height for width, height in sizes) / len(sizes))
    each = [capture.of_views([image]) for image in range(len(capture))]
    weights = how.made_from if isinstance(how, NetworkOptions) else ()
    made_from = how, capture.paths, masks.paths, *weights
    function = partial(_keypoints, how, options.device)
    parts = work.parts("features", made_from, function, each, KEYPOINTS, SECONDS_AN_IMAGE)
    found = dict(recorder.track(parts, len(each), "features", "image"))
    return [Features(*(torch.from_numpy(found[image][name]) for name in FIELDS)) for image in range(len(each))]


def _keypoints(how: SiftOptions | NetworkOptions | Extractor, device: str, photograph: Capture) -> Arrays:
    found = extract_features(photograph.paths[0], how, Masks(photograph).used(0), device)
    return {name: getattr(found, name).numpy() for name in FIELDS}


def made_elsewhere(
    capture: Capture, options: MadeElsewhereOptions, recorder: Recorder, work: Work | None = None
) -> tuple[list[Features], list[PairMatches]]:
    """Keypoints outside the masks of the photographs, and their matches, out of the files that the options name.

    Photographs that the files lack are named, and have no keypoints. Raises CaptureError for files that cannot be used.
    """
    found = read_correspondences(*options.paths, capture.names, sizes_of(capture))
    if found.missing:
        some = ", ".join(found.missing[:3]) + (", ..." if len(found.missing) > 3 else "")
        recorder.note(f"{options.path} has no keypoints of {len(found.missing)} images, which remain out: {some}")
    work = work or Work()
    jobs = [(capture.of_views([image]), pixels) for image, pixels in enumerate(found.pixels)]
    made_from = capture.paths, Masks(capture).paths, found.pixels
    parts = work.parts("colors", made_from, _looked_up, jobs, COLORS, SECONDS_A_LOOK)
    seen = dict(recorder.track(parts, len(jobs), "features", "image"))
    used, colors = ([torch.from_numpy(seen[image][name]) for image in range(len(jobs))] for name in ("used", "colors"))
    return features_and_matches(found, used, colors)


def _looked_up(job: tuple[Capture, Float[Tensor, "k 2"]]) -> Arrays:
    """Which keypoints of a photograph may be used, and their colours."""
    photograph, pixels = job
    allowed, image = Masks(photograph).used(0), read_color(photograph.paths[0])
    column, row = nearest_pixels(pixels.numpy() - 0.5, *image.shape[:2])
    used = np.ones(len(pixels), dtype=np.bool_) if allowed is None else allowed.numpy()[row, column]
    return {"used": used, "colors": colors_at(image, pixels).numpy()}


def sizes_of(capture: Capture) -> list[tuple[int, int]]:
    """Width and height of each photograph, in pixels."""
    return [capture.cameras.sizes[camera] for camera in capture.camera.tolist()]


def match_pairs(
    features: Sequence[Features],
    chosen: ChosenPairs,
    options: MatchOptions,
    recorder: Recorder,
    work: Work | None = None,
    device: str = AUTO,
    sizes: Sequence[tuple[int, int]] = (),
) -> list[PairMatches]:
    """Matches of the pairs that were chosen; device: where descriptors are compared, see `device_of`; sizes: width and
    height of each photograph in pixels, which LightGlue needs."""
    if chosen.by != EXHAUSTIVE:
        recorder.note(f"{len(chosen.pairs)} of {chosen.possible} pairs are matched, chosen by {chosen.by}")
    work, pairs = work or Work(), chosen.pairs.tolist()
    jobs = [_Pairs.of(features, pairs[start : start + AT_ONCE], sizes) for start in range(0, len(pairs), AT_ONCE)]
    described = [[of_image.pixels, of_image.descriptors] for of_image in features]
    made_from = options, chosen.pairs, described, *options.made_from
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
    sizes: tuple[tuple[int, int], ...]

    @classmethod
    def of(
        cls, features: Sequence[Features], pairs: Sequence[Sequence[int]], sizes: Sequence[tuple[int, int]]
    ) -> "_Pairs":
        images = sorted({image for pair in pairs for image in pair})
        place = {image: i for i, image in enumerate(images)}
        places = tuple((place[i], place[j]) for i, j in pairs)
        return cls(tuple(features[image] for image in images), places, tuple(sizes[image] for image in images if sizes))


def _matches(options: MatchOptions, device: str, job: _Pairs) -> Arrays:
    """Of pairs that come one after the other, most of which have the first photograph in common."""
    on = device_of(device)
    if options.matcher == "lightglue":
        some, sizes = job.features, job.sizes
        found = [match_by_lightglue(some[i], some[j], (sizes[i], sizes[j]), options, on) for i, j in job.places]
    else:
        unit = lru_cache(maxsize=2)(lambda place: job.features[place].unit().to(on))
        found = [match(unit(i), unit(j), options) for i, j in job.places]
    return {"count": np.array([len(one) for one in found]), "matches": torch.cat(found).cpu().numpy()}
