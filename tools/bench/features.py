"""Keypoints, matches and tracks of photographs, beside COLMAP's at as many keypoints.

    python tools/bench/features.py FOLDER [--width 1600] [--keypoints 4000]

FOLDER holds photographs, which are reduced to `--width` pixels. COLMAP finds up to `--keypoints` places in each, and up
to two orientations of each place; ours may find as many keypoints as these are in the mean. Matches of both are put to
the same test, COLMAP's two-view geometries, and to the same rule of what a track is. One thread each.
"""

import os

os.environ["OMP_NUM_THREADS"] = "1"

import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
import torch
from baseline import bench_parser, figure

from torchrefrac.features import (
    Features,
    MatchOptions,
    PairMatches,
    SiftOptions,
    build_tracks,
    extract_sift,
    match,
)

FOCAL = 0.58
"""Focal length over width; COLMAP tests pairs by a fundamental matrix, and asks for a camera all the same."""


@dataclass(frozen=True)
class Found:
    """What is found in some photographs: features of each, matches of each pair that agree, and the seconds of both."""

    features: Sequence[Features]
    pairs: Sequence[PairMatches]
    seconds: tuple[float, float]

    def figures(self) -> dict[str, float]:
        """Keypoints an image, matches that agree, and the tracks of two and of more views."""
        tracks, _ = build_tracks(self.features, self.pairs)
        length = torch.bincount(tracks.point)
        return {
            "keypoints an image": sum(len(f) for f in self.features) / len(self.features),
            "matches that agree": sum(len(pair) for pair in self.pairs),
            "tracks": len(length),
            "tracks of three and more": int((length >= 3).sum()),
            "features, s": self.seconds[0],
            "matching, s": self.seconds[1],
        }


def main() -> None:
    parser = bench_parser("Features beside COLMAP's.")
    parser.add_argument("folder", type=Path, help="photographs")
    parser.add_argument("--width", type=int, default=1600)
    parser.add_argument("--keypoints", type=int, default=4000, help="places that COLMAP may find in an image")
    options = parser.parse_args()
    pycolmap.logging.minloglevel = pycolmap.logging.Level.ERROR.value
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    with tempfile.TemporaryDirectory() as folder:
        paths, size = _reduced(options.folder, Path(folder) / "images", options.width)
        peer = _by_colmap(paths, options.keypoints).figures()
        most = round(peer["keypoints an image"])
        ours = {
            choice: _by_ours(paths, size, SiftOptions(max_features=most, choice=choice)).figures()
            for choice in ("strongest", "largest")
        }
    print(f"{len(paths)} photographs of {size[0]} x {size[1]} pixels")
    print(f"{'':<26} {'COLMAP':>8} {'strongest':>10} {'largest':>8} {'ratio':>6}")
    for name, value in peer.items():
        mine = [f"{ours[choice][name]:{width}.6g}" for choice, width in (("strongest", 10), ("largest", 8))]
        ratio = ours["largest"][name] / value
        print(f"{name:<26} {value:8.6g} {' '.join(mine)} {ratio:6.2f}")
        is_time = name.endswith(", s")
        if name != "keypoints an image":
            figure(f"{name.removesuffix(', s')} over COLMAP's", ratio, "x", "lower" if is_time else "higher", 0.1)


def _reduced(folder: Path, into: Path, width: int) -> tuple[list[Path], tuple[int, int]]:
    """The photographs of a folder, made smaller without loss, and their size."""
    into.mkdir()
    paths, size = [], (0, 0)
    for path in sorted(folder.iterdir()):
        image = cv2.imread(str(path))
        if image is None:
            continue
        size = (width, round(image.shape[0] * width / image.shape[1]))
        paths.append(into / f"{path.stem}.png")
        cv2.imwrite(str(paths[-1]), cv2.resize(image, size, interpolation=cv2.INTER_AREA))
    return paths, size


def _by_ours(paths: Sequence[Path], size: tuple[int, int], options: SiftOptions) -> Found:
    start = time.perf_counter()
    features = [extract_sift(path, options) for path in paths]
    found = time.perf_counter()
    pairs = [
        PairMatches(i, j, match(features[i].unit(), features[j].unit(), MatchOptions()))
        for i, j in combinations(range(len(paths)), 2)
    ]
    matched = time.perf_counter()
    return Found(features, [_agreeing(features, pair, size) for pair in pairs], (found - start, matched - found))


def _by_colmap(paths: Sequence[Path], keypoints: int) -> Found:
    folder = paths[0].parent
    database = folder.parent / "database.db"
    extraction: Any = pycolmap.FeatureExtractionOptions()
    extraction.sift.max_num_features = keypoints
    extraction.num_threads, extraction.use_gpu = 1, False
    matching: Any = pycolmap.FeatureMatchingOptions()
    matching.num_threads, matching.use_gpu, matching.skip_geometric_verification = 1, False, True
    start = time.perf_counter()
    pycolmap.extract_features(database, folder, extraction_options=extraction)
    found = time.perf_counter()
    pycolmap.match_exhaustive(database, matching_options=matching)
    matched = time.perf_counter()
    with pycolmap.Database.open(database) as opened:
        images = sorted(opened.read_all_images(), key=lambda image: image.name)
        features = [_colmap_features(opened.read_keypoints(image.image_id)) for image in images]
        size = (opened.read_all_cameras()[0].width, opened.read_all_cameras()[0].height)
        pairs = [
            PairMatches(i, j, torch.from_numpy(opened.read_matches(images[i].image_id, images[j].image_id)).long())
            for i, j in combinations(range(len(images)), 2)
        ]
    return Found(features, [_agreeing(features, pair, size) for pair in pairs], (found - start, matched - found))


def _colmap_features(keypoints: Any) -> Features:
    """Places alone; nothing else of them is looked at."""
    pixels = torch.from_numpy(np.asarray(keypoints, dtype=np.float64)[:, :2])
    k = len(pixels)
    return Features(pixels, torch.zeros(k, 128), torch.zeros(k, 3, dtype=torch.uint8), torch.ones(k).double())


def _agreeing(features: Sequence[Features], pair: PairMatches, size: tuple[int, int]) -> PairMatches:
    """The matches of a pair that agree on a two-view geometry."""
    camera = pycolmap.Camera.create_from_model_id(1, pycolmap.CameraModelId.SIMPLE_PINHOLE, FOCAL * size[0], *size)
    seen = (features[i].pixels.numpy() for i in (pair.first, pair.second))
    options = pycolmap.TwoViewGeometryOptions()
    options.ransac.random_seed = 1
    matches = pair.matches.numpy().astype(np.uint32)
    first, second = seen
    geometry = pycolmap.estimate_two_view_geometry(camera, first, camera, second, matches, options)
    return PairMatches(
        pair.first, pair.second, torch.from_numpy(np.asarray(geometry.inlier_matches)).long().view(-1, 2)
    )


if __name__ == "__main__":
    main()
