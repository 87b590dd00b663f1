"""Photographs that show more land than water."""

from dataclasses import replace

import pytest
import torch

from tests.sfm.test_reconstruct_sparse import reconstruct
from torchrefrac.geometry import Similarity
from torchrefrac.scene import Interfaces
from torchrefrac.sfm import PairPose, SfmOptions, fits_better_in_air, mostly_land, verify_pairs
from torchrefrac.sfm.frame import transformed
from torchrefrac.sfm.land import flooded
from torchrefrac.sfm.rules import Rules
from torchrefrac.sfm.verification import VerifiedPair

RISE = 5.0


@pytest.fixture
def by_land(survey_of):
    """`by_land(land, points)`: a survey and its scene as its land alone gives it, RISE higher, without water."""

    def make(land, points):
        survey = survey_of(cameras=5, points=points, land=land, noise=0.1)
        scene = survey.scene(with_points=True)
        air = replace(scene, interfaces=Interfaces.level(1.0))
        above = scene.points[:, 2] > 0.0
        air = replace(air, placed=above, accepted=above[air.observations.point])
        lift = torch.tensor((0.0, 0.0, RISE), dtype=torch.float64)
        one = torch.ones((), dtype=torch.float64)
        return survey, transformed(air, Similarity(one, torch.eye(3, dtype=torch.float64), lift))

    return make


def test_the_water_beside_the_land_is_found_with_the_tracks_that_are_seen_through_it(by_land):
    survey, scene = by_land(200, 280)

    found = flooded(scene, 1.33, Rules())

    level = float(found.interfaces.offset[0])
    assert RISE - 15.0 < level < RISE + 10.0
    assert float(found.interfaces.index_ratio[0]) == 1.33
    assert not bool(found.placed[survey.basin.points[:, 2] < 0.0].any())
    assert float(found.placed[survey.basin.points[:, 2] > 8.0].double().mean()) > 0.9


def test_where_there_is_land_alone_no_water_is_found(by_land):
    _, scene = by_land(200, 200)

    assert flooded(scene, 1.33, Rules()) is None


def test_photographs_of_water_do_not_fit_better_in_air(survey_of):
    survey = survey_of(cameras=5, points=120, noise=0.1)

    assert not fits_better_in_air(reconstruct(survey), survey.capture)


class _Agreeing:
    """Of every pair the first `share` of the matches agree."""

    def __init__(self, share):
        self.share = share

    def relative(self, images, pixels, generator):
        count = len(pixels[0])
        return PairPose(None, None, torch.arange(count) < self.share * count, 0.1)


@pytest.mark.parametrize(("share", "turned", "land"), [(0.5, False, True), (1.0, False, False), (0.5, True, False)])
def test_land_is_where_pinholes_explain_more_and_agree_with_gravity(
    survey_of, generator, recorder, share, turned, land
):
    survey = survey_of(cameras=4, points=200, index_ratio=1.0, noise=0.1, gravity_error_deg=0.2)
    capture, matches, features = survey.capture, survey.pairs(), survey.features()
    if turned:
        mirrored = capture.down_in_cam * capture.down_in_cam.new_tensor((1.0, -1.0, 1.0))
        every_other = torch.arange(4)[:, None] % 2 == 0
        capture = replace(capture, down_in_cam=torch.where(every_other, mirrored, capture.down_in_cam))
    verified: list[VerifiedPair] = verify_pairs(matches, features, _Agreeing(share), 10, generator, recorder)

    assert mostly_land(capture, matches, verified, features, SfmOptions()) is land
