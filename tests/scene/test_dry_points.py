"""Points that are seen straight although they lie below the water's level."""

from dataclasses import replace

import pytest
import torch

from tests.planted_reconstructions import plant_reconstruction
from tests.tolerances import assert_matches
from torchrefrac.scene import SceneError


@pytest.fixture(params=[1, 2], ids=["level", "two surfaces"])
def scene(request, make_basin, draw):
    truth = plant_reconstruction(make_basin(cameras=4, points=30), draw, interfaces=request.param).truth
    return replace(truth, dry=torch.arange(30) % 3 == 0)


def test_dry_points_are_seen_as_by_a_pinhole_and_the_others_through_water(scene):
    seen = scene.observations
    wet = replace(scene, dry=None)
    dry = scene.dry[seen.point]

    pixels, valid = scene.cameras_of(seen).project(scene.points[seen.point])

    straight, _ = wet.cameras_of(seen).as_pinhole().project(wet.points[seen.point])
    bent, _ = wet.cameras_of(seen).project(wet.points[seen.point])
    assert valid.all()
    assert torch.equal(pixels[dry], straight[dry])
    assert torch.equal(pixels[~dry], bent[~dry])
    assert (straight - bent)[dry].norm(dim=-1).median() > 1.0


def test_rays_towards_dry_points_go_straight_from_the_centre(scene):
    seen = scene.observations
    dry = scene.dry[seen.point]

    origins, before, after, _ = scene.cameras_of(seen).follow_rays(seen.pixels)

    assert torch.equal(origins[dry], scene.views.center[seen.view][dry])
    assert_matches(after[dry], before[dry])
    assert (after - before)[~dry].norm(dim=-1).median() > 0.01


def test_errors_are_those_in_the_medium_of_each_point(scene):
    dry = scene.dry[scene.observations.point]
    assert scene.errors()[~dry].max() < 1e-9
    assert scene.errors()[dry].median() > 1.0


def test_a_part_and_what_is_left_of_a_scene_know_which_points_are_dry(scene):
    accepted = scene.accepted & (scene.observations.point % 2 == 0)
    for left in (replace(scene, accepted=accepted).part().scene, replace(scene, accepted=accepted).trimmed()):
        assert left.dry is not None
        assert torch.equal(left.dry, scene.dry[::2])


def test_only_what_is_dry_and_below_the_surface_lies_outside_the_water(scene):
    points = torch.where(
        (torch.arange(30) < 10)[:, None], scene.points * scene.points.new_tensor((1, 1, -1)), scene.points
    )
    scene = replace(scene, points=points, placed=torch.arange(30) != 12)
    wanted = scene.dry & (torch.arange(30) >= 10) & (torch.arange(30) != 12)
    assert torch.equal(scene.outside_water(), wanted)
    assert int(replace(scene, dry=None).outside_water().sum()) == 0


def test_dry_must_be_as_long_as_the_points(scene):
    with pytest.raises(SceneError, match="dry has shape"):
        replace(scene, dry=scene.dry[1:]).check()
