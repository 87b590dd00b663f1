"""Surveys of a basin: what a user's photographs would tell of it, without the photographs."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from torchrefrac.bundle import BundleOptions, GravityPrior
from torchrefrac.features import Features, PairMatches
from torchrefrac.geometry import so3_exp
from torchrefrac.recorder import SilentRecorder
from torchrefrac.scene import Cameras, Capture, Interfaces, Observations, Part, Scene
from torchrefrac.sfm import Rules


@dataclass(frozen=True)
class Survey:
    """basin: the truth, its points being those of the tracks. wrong (k): the observations that show something else.
    colors (n, 3): the number of a point in base 256."""

    basin: Any
    capture: Capture
    seen: Observations
    colors: Tensor
    wrong: Tensor

    def tracks(self) -> Scene:
        """Nothing has a place yet."""
        return Scene.of_capture(self.capture, self.seen, self.colors, self.basin.index_ratio)

    def scene(self, *, with_points: bool = False) -> Scene:
        """All views at their true poses; `with_points`: all points at their true places, all observations accepted."""
        scene = self.tracks()
        scene = replace(scene, views=scene.views.at(self.basin.rotation, self.basin.center))
        if not with_points:
            return scene
        return replace(
            scene,
            points=self.basin.points,
            placed=torch.ones_like(scene.placed),
            accepted=torch.ones_like(scene.accepted),
        )

    def features(self) -> list[Features]:
        """The observations of each view as its keypoints."""
        return [
            Features(seen.pixels, torch.zeros(len(seen), 128), self.colors[seen.point], torch.ones(len(seen)).double())
            for seen in (self.seen[self.seen.view == view] for view in range(len(self.capture)))
        ]

    def pairs(self) -> list[PairMatches]:
        """For any two views the keypoints that belong to the same track."""
        keypoint = [self.seen.point[self.seen.view == view] for view in range(len(self.capture))]
        return [
            PairMatches(first, second, (keypoint[first][:, None] == keypoint[second]).nonzero())
            for first, second in combinations(range(len(self.capture)), 2)
        ]

    def common(self, *views: int) -> tuple[Tensor, ...]:
        """Pixels of the tracks that all `views` see, view by view, which of these tracks are right in all, and their
        numbers."""
        rows = [self.seen.view == view for view in views]
        count = torch.stack([torch.bincount(self.seen.point[row], minlength=len(self.colors)) for row in rows])
        rows = [row & (count > 0).all(dim=0)[self.seen.point] for row in rows]
        right = ~torch.stack([self.wrong[row] for row in rows]).any(dim=0)
        return *(self.seen.pixels[row] for row in rows), right, self.seen.point[rows[0]]


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
            down_sigma=torch.full((cameras,), max(gravity_error_deg, 0.01)).double().deg2rad(),
            height=basin.center[:, 2],
            has_height=torch.arange(cameras) == 0,
            length_unit="cm",
        )
        number = torch.arange(points)
        colors = torch.stack((number % 256, number // 256, 0 * number), dim=-1).to(torch.uint8)
        seen = Observations(image, track, torch.where(wrong[:, None], anywhere, observed))
        return Survey(basin, capture, seen, colors, wrong)

    return make


@pytest.fixture
def rules_of() -> Callable[..., Rules]:
    """`rules_of(survey, bundle)`: with the gravity of a survey as a prior, but in air."""

    def make(survey: Survey, bundle: BundleOptions) -> Rules:
        capture = survey.capture

        def gravity(part: Part) -> list[GravityPrior]:
            if survey.basin.index_ratio == 1.0:
                return []
            return [GravityPrior(capture.down_in_cam[part.view], capture.down_sigma[part.view])]

        return Rules(bundle=bundle, measurements=gravity)

    return make
