"""Keypoints of the photographs of a capture, and which of them look alike."""

from itertools import combinations

from torchrefrac.config import Options
from torchrefrac.features import Features, PairMatches, extract_sift, match
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


def match_all(features: list[Features], options: Options, recorder: Recorder) -> list[PairMatches]:
    """Matches of every pair of photographs."""
    every = list(combinations(range(len(features)), 2))
    return [
        PairMatches(i, j, match(features[i].descriptors, features[j].descriptors, options.matching))
        for i, j in recorder.track(every, len(every), "matching", "pair")
    ]
