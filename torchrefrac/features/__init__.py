"""Keypoints, matches and tracks."""

from torchrefrac.features.matching import MatchOptions, match
from torchrefrac.features.retrieval import likeness
from torchrefrac.features.sift import Features, SiftOptions, extract_sift
from torchrefrac.features.tracks import PairMatches, build_tracks

__all__ = [
    "Features", "MatchOptions", "PairMatches", "SiftOptions", "build_tracks", "extract_sift", "likeness", "match",
]  # fmt: skip
