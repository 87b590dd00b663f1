"""Keypoints of the photographs of a capture, and which of them look alike."""

from collections.abc import Sequence

from torchrefrac.commands.pairs import ChosenPairs
from torchrefrac.config import Options
from torchrefrac.features import Features, MatchOptions, PairMatches, extract_sift, match
from torchrefrac.features.matching import EXHAUSTIVE
from torchrefrac.files.masks import Masks
from torchrefrac.recorder import Recorder
from torchrefrac.scene import Capture


def extract(capture: Capture, options: Options, recorder: Recorder) -> list[Features]:
    """Keypoints of every photograph, outside its mask."""
    masks = Masks(capture)
    sizes = [capture.cameras.sizes[camera] for camera in capture.camera.tolist()]
    how = options.features.for_images(sum(width * height for width, height in sizes) / len(sizes))
    paths = recorder.track(capture.paths, len(capture), "features", "image")
    return [extract_sift(path, how, masks.used(i)) for i, path in enumerate(paths)]


def match_pairs(
    features: Sequence[Features], chosen: ChosenPairs, options: MatchOptions, recorder: Recorder
) -> list[PairMatches]:
    """Matches of the pairs that were chosen."""
    if chosen.by != EXHAUSTIVE:
        recorder.note(f"{len(chosen.pairs)} of {chosen.possible} pairs are matched, chosen by {chosen.by}")
    return [
        PairMatches(i, j, match(features[i].descriptors, features[j].descriptors, options))
        for i, j in recorder.track(chosen.pairs.tolist(), len(chosen.pairs), "matching", "pair")
    ]
