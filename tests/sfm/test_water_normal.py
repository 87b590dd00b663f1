"""The normal of the water in a model that stands anywhere."""

from dataclasses import replace

import pytest
import torch

from tests.planted_reconstructions import plant_reconstruction
from tests.sfm.test_placing import ELSEWHERE
from torchrefrac.bundle import UnadjustableError
from torchrefrac.scene import Interfaces, Survey
from torchrefrac.sfm import ReadjustOptions, readjust, with_found_normal
from torchrefrac.sfm.frame import moved, transformed
from torchrefrac.sfm.vertical import angle_between
from torchrefrac.sfm.water_normal import candidate_normals


def finding(options):
    """Options by which tilt and height of the plane vary."""
    return replace(options, bundle=replace(options.bundle, refine=("plane_tilt", "plane_height")))


@pytest.fixture
def planted(make_basin, draw):
    """Six cameras and 120 points, 0.1 pixels of noise."""
    return plant_reconstruction(make_basin(cameras=6, points=120, seen_by=3), draw, 0.1)


def test_normal_and_level_are_found_in_any_frame(planted):
    given, options = moved(planted.truth, ELSEWHERE), finding(ReadjustOptions())
    unknown = replace(given, interfaces=Interfaces.level(1.33))
    survey = Survey.empty(given.views.names)

    found, _ = with_found_normal(unknown, survey, options)

    def assert_right(scene, degrees):
        off = angle_between(scene.interfaces.normal[0], given.interfaces.normal[0])
        assert float(off.rad2deg()) < degrees
        height, true = (
            (of.views.center @ of.interfaces.normal[0] - of.interfaces.offset).mean() for of in (scene, given)
        )
        assert float(height / true) == pytest.approx(1.0, abs=0.01)

    assert_right(found, 0.5)
    adjusted, outcome = readjust(found, survey, options)
    assert outcome.report.fixed == {}
    assert float(adjusted.assessment.tilt_sigma) < 0.003
    assert_right(adjusted, 0.3)


def test_nothing_is_found_where_nothing_refracts(planted):
    dry = replace(planted.truth, interfaces=Interfaces.level(1.0))

    with pytest.raises(UnadjustableError, match=r"cannot be seen at an index ratio of 1; give plane.normal, or"):
        with_found_normal(dry, Survey.empty(dry.views.names), finding(ReadjustOptions()))


def test_what_does_not_determine_the_tilt_is_refused(make_basin, draw):
    """Two cameras that see few points with large errors."""
    truth = plant_reconstruction(make_basin(cameras=2, points=9), draw, 3.0).truth

    with pytest.raises(
        UnadjustableError, match=r"give plane.normal, or down_in_cam of some images or positions of three"
    ):
        with_found_normal(truth, Survey.empty(truth.views.names), finding(ReadjustOptions()))


def test_candidates_point_from_points_to_cameras(planted):
    scene = transformed(planted.truth, ELSEWHERE)

    normals = candidate_normals(scene)

    torch.testing.assert_close(normals.norm(dim=-1), torch.ones(len(normals)).double())
    assert bool(((scene.points @ normals.T).median(dim=0).values < (scene.views.center @ normals.T).amin(dim=0)).all())
    off = angle_between(normals, ELSEWHERE.rotation[:, 2])
    assert float(off.min().rad2deg()) < 15.0
