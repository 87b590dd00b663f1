"""Surveys of a basin: what a user's photographs would tell of it, without the photographs."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from torchrefrac.features import Features, PairMatches
from torchrefrac.geometry import so3_exp
from torchrefrac.recorder import SilentRecorder
from torchrefrac.scene import Cameras, Capture, Interfaces, Tracks
from torchrefrac.sfm.model import SparseModel


@dataclass(frozen=True)
class Survey:
    """basin: the truth, its points being those of the tracks. wrong (N): the observations that show something else."""

    basin: Any
    capture: Capture
    tracks: Tracks
    wrong: Tensor

    @property
    def index_ratio(self) -> Tensor:
        return torch.tensor(self.basin.index_ratio, dtype=torch.float64)

    def model(self, *, with_points: bool = False) -> SparseModel:
        """All images at their true poses; `with_points`: all points at their true places, all observations active."""
        count = len(self.capture)
        model = SparseModel.empty(self.tracks, count, self.capture.intrinsics, self.index_ratio)
        model = replace(
            model,
            registered=torch.ones(count, dtype=torch.bool),
            rotation=self.basin.rotation,
            center=self.basin.center,
        )
        if not with_points:
            return model
        return replace(
            model,
            points=self.basin.points,
            has_point=torch.ones_like(model.has_point),
            active=torch.ones_like(model.active),
        )

    def features(self) -> list[Features]:
        """The observations of each image as its keypoints."""
        return [
            Features(
                self.tracks.pixels[self.tracks.image == image],
                torch.zeros(int((self.tracks.image == image).sum()), 128),
                self.tracks.colors[self.tracks.image == image],
            )
            for image in range(len(self.capture))
        ]

    def pairs(self) -> list[PairMatches]:
        """For any two images the keypoints that belong to the same track."""
        keypoint = [self.tracks.track[self.tracks.image == image] for image in range(len(self.capture))]
        return [
            PairMatches(first, second, (keypoint[first][:, None] == keypoint[second]).nonzero())
            for first, second in combinations(range(len(self.capture)), 2)
        ]

    def common(self, *images: int) -> tuple[Tensor, ...]:
        """Pixels of the tracks that all `images` see, image by image, and which of these tracks are right in all."""
        rows = [self.tracks.image == image for image in images]
        seen = torch.stack([torch.bincount(self.tracks.track[row], minlength=self.tracks.num_tracks) for row in rows])
        rows = [row & (seen > 0).all(dim=0)[self.tracks.track] for row in rows]
        right = ~torch.stack([self.wrong[row] for row in rows]).any(dim=0)
        return *(self.tracks.pixels[row] for row in rows), right, self.tracks.track[rows[0]]


class Curves(SilentRecorder):
    """Keeps the scalars: name, value, step."""

    def __init__(self) -> None:
        self.scalars: list[tuple[str, float, int]] = []

    def scalar(self, name: str, value: float, step: int) -> None:
        self.scalars.append((name, value, step))


@pytest.fixture
def recorder() -> Curves:
    return Curves()


@pytest.fixture
def survey_of(make_basin, draw, tmp_path) -> Callable[..., Survey]:
    """`survey_of(cameras=4, points=60, ...)`: tracks of two or more images with `noise` in pixels, a share `outliers`
    of observations at random pixels, and gravity that is off by about `gravity_error_deg`. Only the first camera's
    height is measured."""

    def make(cameras=4, points=60, noise=0.0, outliers=0.0, gravity_error_deg=0.0, **scene) -> Survey:
        basin = make_basin(cameras=cameras, points=points, seen_by=2, **scene)
        pixels, seen = basin.project()
        track, image = seen.T.nonzero(as_tuple=True)
        observed = pixels[image, track] + noise * draw.normal(len(image), 2)
        wrong = draw.uniform(0.0, 1.0, len(image)) < outliers
        anywhere = draw.uniform(0.0, 1.0, len(image), 2) * observed.new_tensor((1024.0, 768.0))
        tilt = so3_exp(torch.deg2rad(torch.tensor(gravity_error_deg)) * draw.directions(cameras))
        names = tuple(f"{i}.jpg" for i in range(cameras))
        capture = Capture(
            folder=tmp_path,
            names=names,
            paths=tuple(Path(tmp_path / name) for name in names),
            cameras=Cameras.of([basin.lens]),
            interfaces=Interfaces.level(basin.index_ratio),
            down_in_cam=(tilt @ basin.down_in_cam[..., None])[..., 0],
            down_sigma=float(torch.deg2rad(torch.tensor(max(gravity_error_deg, 0.01)))),
            height=basin.center[:, 2],
            has_height=torch.arange(cameras) == 0,
            length_unit="cm",
        )
        colors = torch.stack((track % 256, track // 256, 0 * track), dim=-1).to(torch.uint8)
        tracks = Tracks(image, track, torch.where(wrong[:, None], anywhere, observed), colors, points)
        return Survey(basin, capture, tracks, wrong)

    return make
