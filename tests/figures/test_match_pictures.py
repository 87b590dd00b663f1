"""Pictures of matches and residuals show them where they are."""

from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from torchrefrac.features import Features, PairMatches
from torchrefrac.figures.matches import (
    GREEN,
    STRIP,
    WIDTH,
    YELLOW,
    exaggeration,
    match_picture,
    record_matches,
    record_residuals,
    residual_picture,
    spread,
)
from torchrefrac.geometry import Rigid
from torchrefrac.recorder import SilentRecorder
from torchrefrac.scene import Cameras, Capture, Interfaces, Observations, Scene
from torchrefrac.sfm import VerifiedPair
from torchrefrac.sfm.pose import PairPose


class Album(SilentRecorder):
    """Keeps the pictures by name."""

    def __init__(self):
        self.pictures = {}

    @property
    def wants_pictures(self):
        return True

    def picture(self, name, image, step):
        self.pictures[name] = image


@dataclass(frozen=True)
class Photographed:
    capture: Capture
    scene: Scene


@pytest.fixture
def photographed(make_basin, tmp_path):
    """Grey photographs of a basin, reconstructed without error."""

    def make(cameras=4, **scene):
        basin = make_basin(cameras=cameras, points=40, seen_by=2, **scene)
        intrinsics = basin.lens
        names = tuple(f"{i}.png" for i in range(cameras))
        for name in names:
            cv2.imwrite(
                str(tmp_path / name), np.full((int(intrinsics.height), int(intrinsics.width), 3), 100, dtype=np.uint8)
            )
        paths = tuple(Path(tmp_path / name) for name in names)
        flags = torch.zeros(cameras, dtype=torch.bool)
        capture = Capture(
            tmp_path,
            names,
            paths,
            Cameras.of([intrinsics]),
            Interfaces.level(basin.index_ratio),
            basin.down_in_cam,
            torch.full((cameras,), 0.01, dtype=torch.float64),
            basin.center[:, 2],
            flags,
            "cm",
        )
        pixels, seen = basin.project()
        point, view = seen.T.nonzero(as_tuple=True)
        found = Scene.create(
            Rigid(basin.rotation, basin.center), intrinsics, capture.interfaces, basin.points,
            Observations(view, point, pixels[view, point]), names=names, length_unit="cm",
        )  # fmt: skip
        return Photographed(capture, found)

    return make


def of_color(picture, color):
    """Where a picture has about this colour: lines fade at their borders."""
    return (np.abs(np.asarray(picture).astype(int) - color) < 90).all(axis=-1)


def test_a_match_joins_its_two_places():
    first, second = (np.full((300, 400, 3), 40, dtype=np.uint8) for _ in range(2))
    one = torch.tensor([[100.0, 150.0]], dtype=torch.float64)
    two = torch.tensor([[300.0, 50.0]], dtype=torch.float64)

    picture = match_picture(first, second, one, two)

    rows, columns = of_color(picture, GREEN).nonzero()
    assert picture.shape == (450, WIDTH, 3)
    assert (columns.min(), columns.max()) == pytest.approx((150, 1050), abs=2)
    assert rows[columns.argmin()] == pytest.approx(225, abs=2)
    assert rows[columns.argmax()] == pytest.approx(75, abs=2)


def test_photographs_of_different_heights_stand_side_by_side():
    nothing = torch.zeros(0, 2, dtype=torch.float64)

    picture = match_picture(
        np.full((200, 400, 3), 40, np.uint8), np.full((400, 400, 3), 80, np.uint8), nothing, nothing
    )

    assert picture.shape == (600, WIDTH, 3)
    assert (picture[100, 100, 0], picture[500, 100, 0], picture[500, 900, 0]) == (40, 0, 80)


def test_a_residual_is_drawn_so_many_times_as_long_on_a_darker_photograph():
    photograph = np.full((300, 600, 3), (20, 40, 200), dtype=np.uint8)
    pixels, residuals = (torch.tensor([place], dtype=torch.float64) for place in ([200.0, 100.0], [0.5, 0.0]))

    picture = residual_picture(photograph, pixels, residuals, 50.0)

    rows, columns = of_color(picture, YELLOW).nonzero()
    assert picture[500, 1000].tolist() == [100, 20, 10]
    assert (columns.min(), columns.max()) == pytest.approx((399, 450), abs=2)
    assert rows.mean() == pytest.approx(199.5, abs=1.0)


@pytest.mark.parametrize(
    ("median", "width", "factor"), [(0.1, 1200, 100), (0.1, 600, 50), (12.0, 1200, 1), (0.0, 1200, 1000)]
)
def test_residuals_are_exaggerated_by_a_round_factor_that_makes_them_readable(median, width, factor):
    residuals = torch.tensor([[median, 0.0], [0.0, median]], dtype=torch.float64)

    assert exaggeration(residuals, width) == factor


def test_few_images_are_spread_over_all():
    assert spread(torch.arange(100), 5).tolist() == [0, 25, 50, 74, 99]
    assert spread(torch.arange(3), 5).tolist() == [0, 1, 2]


def verified(first, second, count):
    matches = torch.arange(count)[:, None].expand(-1, 2)
    pose = PairPose(None, None, torch.ones(count, dtype=torch.bool), 0.1)
    return VerifiedPair(PairMatches(first, second, matches), pose, count + 5)


def features(image):
    pixels = torch.stack((torch.arange(30.0), torch.full((30,), 50.0 + image)), dim=-1).double()
    return Features(pixels, torch.zeros(30, 128), torch.zeros(30, 3, dtype=torch.uint8), torch.ones(30).double())


def test_the_best_pairs_are_shown_of_which_none_shares_an_image_where_that_is_possible(photographed, monkeypatch):
    capture, read = photographed().capture, []
    pairs = [verified(0, 1, 20), verified(0, 2, 19), verified(2, 3, 10), verified(1, 3, 9)]
    album = Album()
    original = cv2.imread
    monkeypatch.setattr(cv2, "imread", lambda path, *rest: read.append(Path(path).name) or original(path, *rest))

    record_matches(capture, [features(image) for image in range(4)], pairs, album)

    assert list(album.pictures) == ["matches/0 - 1", "matches/2 - 3", "matches/0 - 2"]
    assert read == ["0.png", "1.png", "2.png", "3.png", "0.png", "2.png"]


def test_residuals_of_a_few_registered_images_are_shown(photographed):
    planted = photographed(cameras=12)
    registered = torch.arange(12) != 3
    album = Album()

    record_residuals(
        planted.capture, replace(planted.scene, views=replace(planted.scene.views, registered=registered)), album
    )

    assert len(album.pictures) == 6
    assert {"residuals/0", "residuals/11"} <= set(album.pictures)
    assert "residuals/3" not in album.pictures
    assert all(image.dtype == torch.uint8 and image.shape[1:] == (WIDTH, 3) for image in album.pictures.values())


def test_an_image_without_observations_is_shown_without_residuals(photographed):
    planted = photographed(cameras=2)
    empty = planted.scene.with_points(planted.scene.points, planted.scene.colors)
    album = Album()

    record_residuals(planted.capture, empty, album)

    assert [bool(of_color(image[STRIP:], YELLOW).any()) for image in album.pictures.values()] == [False, False]


def test_nobody_who_wants_no_pictures_reads_photographs(photographed):
    planted = photographed(cameras=2)
    for path in planted.capture.paths:
        path.unlink()

    record_matches(planted.capture, [features(0), features(1)], [verified(0, 1, 20)], SilentRecorder())
    record_residuals(planted.capture, planted.scene, SilentRecorder())
