"""Keypoints, matches and tracks."""

from torchrefrac.features.elsewhere import MadeElsewhereOptions
from torchrefrac.features.extractor import Extractor, extract_features
from torchrefrac.features.matching import MatchOptions, match
from torchrefrac.features.networks import Detected, NetworkOptions, WeightsError, extract_by_network
from torchrefrac.features.retrieval import likeness
from torchrefrac.features.sift import Features, SiftOptions, extract_sift
from torchrefrac.features.tracks import PairMatches, build_tracks

__all__ = [
    "Detected", "Extractor", "Features", "MadeElsewhereOptions", "MatchOptions", "NetworkOptions", "PairMatches",
    "SiftOptions", "WeightsError", "build_tracks", "extract_by_network", "extract_features", "extract_sift", "likeness",
    "match",
]  # fmt: skip
