"""Photographs with what was found in them, for a person who watches a run: matches of pairs, residuals of images."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from torchrefrac.features import Features
from torchrefrac.files.photographs import read_color
from torchrefrac.recorder import Recorder
from torchrefrac.scene import Capture, Scene
from torchrefrac.sfm import VerifiedPair

WIDTH = 1200  # of a picture, pixels
MOST_PAIRS, MOST_LINES = 3, 120
MOST_IMAGES = 6
FACTORS = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)  # by which residuals may be exaggerated
READABLE = WIDTH / 100  # how long a median residual should be in a picture, pixels
STRIP = 30  # height of the strip with text, pixels
YELLOW, GREEN = (255, 220, 0), (70, 230, 120)


class StagePictures:
    """Gives the pictures of each finished stage of a reconstruction to a recorder."""

    def __init__(self, capture: Capture, recorder: Recorder) -> None:
        self._capture, self._recorder = capture, recorder
        self._features: Sequence[Features] = ()

    def stage_done(self, name: str, product: Any) -> None:
        """After "features" (list of Features), "matching" (list of VerifiedPair) and "sparse" (Scene)."""
        if name == "features":
            self._features = product
        elif name == "matching":
            record_matches(self._capture, self._features, product, self._recorder)
        elif name == "sparse":
            record_residuals(self._capture, product, self._recorder)


def record_matches(
    capture: Capture, features: Sequence[Features], pairs: Sequence[VerifiedPair], recorder: Recorder
) -> None:
    """Pictures of the pairs with most inliers, none of which shares an image with another where that is possible; the
    photographs are read for them. Nothing where the recorder wants none."""
    if not recorder.wants_pictures:
        return
    for pair in _best(pairs):
        first, second = pair.pair.first, pair.pair.second
        one, two = (features[image].pixels[pair.pair.matches[:, k]] for k, image in enumerate((first, second)))
        picture = match_picture(read_color(capture.paths[first]), read_color(capture.paths[second]), one, two)
        names = [capture.names[image] for image in (first, second)]
        agree = f"{len(pair.pair)} of {pair.num_putative} matches agree on a pose"
        _write(picture, f"{names[0]} - {names[1]}: {agree}")
        recorder.picture(f"matches/{' - '.join(map(_stem, names))}", torch.from_numpy(picture), 0)


def record_residuals(capture: Capture, scene: Scene, recorder: Recorder) -> None:
    """Pictures of the residuals of a few images, spread over those that are registered. Nothing where the recorder
    wants none."""
    if not recorder.wants_pictures:
        return
    rows, residuals = _residuals(scene)
    image, pixels = scene.observations.view[rows], scene.observations.pixels[rows]
    widths = torch.tensor([width for width, _ in capture.cameras.sizes])[capture.camera]
    factor = exaggeration(residuals, widths[image])
    for i in spread(scene.views.registered.nonzero()[:, 0], MOST_IMAGES).tolist():
        here = image == i
        picture = residual_picture(read_color(capture.paths[i]), pixels[here], residuals[here], factor)
        median = float(residuals[here].norm(dim=-1).median()) if bool(here.any()) else 0.0
        about = f"{int(here.sum())} residuals {factor} times as long, median {median:.2f} px"
        _write(picture, f"{capture.names[i]}: {about}")
        recorder.picture(f"residuals/{_stem(capture.names[i])}", torch.from_numpy(picture), 0)


def _stem(name: str) -> str:
    return str(Path(name).with_suffix(""))


def match_picture(
    first: UInt8[np.ndarray, "h1 w1 3"],
    second: UInt8[np.ndarray, "h2 w2 3"],
    one: Float[Tensor, "k 2"],
    two: Float[Tensor, "k 2"],
) -> UInt8[np.ndarray, "height width 3"]:
    """Two photographs, BGR, side by side, with their pixels `one` and `two` joined by lines, of at most about a hundred
    matches; RGB, WIDTH wide."""
    left, right = _narrow(first, WIDTH // 2), _narrow(second, WIDTH // 2)
    picture = np.zeros((max(len(left), len(right)), WIDTH, 3), dtype=np.uint8)
    picture[: len(left), : WIDTH // 2] = left
    picture[: len(right), WIDTH // 2 :] = right
    chosen = spread(torch.arange(len(one)), MOST_LINES)
    from_left = one[chosen] * (WIDTH / 2 / first.shape[1])
    from_right = two[chosen] * (WIDTH / 2 / second.shape[1]) + two.new_tensor((WIDTH / 2, 0.0))
    _lines(picture, from_left, from_right, GREEN)
    return picture


def residual_picture(
    photograph: UInt8[np.ndarray, "h w 3"], pixels: Float[Tensor, "k 2"], residuals: Float[Tensor, "k 2"], factor: float
) -> UInt8[np.ndarray, "height width 3"]:
    """A photograph, BGR, darkened, with residuals at pixels, both of the photograph, as lines `factor` times as long;
    RGB, WIDTH wide."""
    picture = _narrow(photograph, WIDTH) // 2
    scale = WIDTH / photograph.shape[1]
    _lines(picture, pixels * scale, pixels * scale + factor * scale * residuals, YELLOW)
    return picture


def exaggeration(residuals: Float[Tensor, "n 2"], width: Int[Tensor, " n"] | int) -> int:
    """The round factor at which a median residual of images of this width is about READABLE pixels long."""
    if not len(residuals):
        return 1
    wanted = READABLE / max(float((residuals.norm(dim=-1) * (WIDTH / width)).median()), 1e-9)
    return min(FACTORS, key=lambda factor: abs(np.log(factor / wanted)))


def spread(items: Int[Tensor, " n"], most: int) -> Int[Tensor, " m"]:
    """At most `most` of the items, evenly spread over them."""
    if len(items) <= most:
        return items
    return items[torch.linspace(0.0, len(items) - 1.0, most).round().long()]


def _best(pairs: Sequence[VerifiedPair]) -> list[VerifiedPair]:
    ordered = sorted(pairs, key=lambda pair: -len(pair.pair))
    best: list[VerifiedPair] = []
    seen: set[int] = set()
    for pair in ordered:
        if seen.isdisjoint((pair.pair.first, pair.pair.second)):
            best.append(pair)
            seen |= {pair.pair.first, pair.pair.second}
    return (best + [pair for pair in ordered if pair not in best])[:MOST_PAIRS]


def _residuals(scene: Scene) -> tuple[Int[Tensor, " k"], Float[Tensor, "k 2"]]:
    """Which observations can be projected, and by how much the projection misses them."""
    projected, valid = scene.cameras_of(scene.observations).project(scene.points[scene.observations.point])
    rows = valid.nonzero()[:, 0]
    return rows, projected[rows] - scene.observations.pixels[rows]


def _narrow(photograph: UInt8[np.ndarray, "h w 3"], width: int) -> UInt8[np.ndarray, "height width 3"]:
    """RGB of the photograph, BGR, `width` wide."""
    height = round(photograph.shape[0] * width / photograph.shape[1])
    method = cv2.INTER_AREA if width < photograph.shape[1] else cv2.INTER_LINEAR
    return cv2.cvtColor(cv2.resize(photograph, (width, height), interpolation=method), cv2.COLOR_BGR2RGB)


def _lines(
    picture: UInt8[np.ndarray, "h w 3"],
    start: Float[Tensor, "k 2"],
    end: Float[Tensor, "k 2"],
    color: tuple[int, int, int],
) -> None:
    """Lines from start to end, with a dot at each start; pixel centres of the picture are at halves."""
    both = ((torch.stack((start, end), dim=1) - 0.5).clamp(-1e5, 1e5)).round().int().numpy()
    cv2.polylines(picture, list(both), False, color, 1, cv2.LINE_AA)
    for x, y in both[:, 0].tolist():
        cv2.circle(picture, (x, y), 1, color, -1)


def _write(picture: UInt8[np.ndarray, "h w 3"], text: str) -> None:
    """A line of text in a dark strip at the top."""
    picture[:STRIP] //= 4
    cv2.putText(picture, text, (10, STRIP - 9), cv2.FONT_HERSHEY_SIMPLEX, 0.6, (255, 255, 255), 1, cv2.LINE_AA)
