"""Photographs that show more land than water."""

from dataclasses import replace

import pytest
import torch

from tests.sfm.test_reconstruct_sparse import reconstruct
from torchrefrac.geometry import Similarity
from torchrefrac.scene import Interfaces
from torchrefrac.sfm import fits_better_in_air
from torchrefrac.sfm.frame import transformed
from torchrefrac.sfm.land import flooded
from torchrefrac.sfm.rules import Rules

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
