"""Observations that descriptors alone did not find."""

from dataclasses import replace

import pytest
import torch

from torchrefrac.features import Features
from torchrefrac.sfm.complete_tracks import complete_tracks


@pytest.fixture
def known(survey_of, draw):
    """The true scene of a survey, and its keypoints, whose descriptors are those of their points."""
    survey = survey_of(cameras=5, points=80, noise=0.05)
    scene = survey.scene(with_points=True)
    seen = replace(scene.observations, noise=torch.ones(len(scene.observations)).double())
    of_points = torch.nn.functional.normalize(draw.normal(80, 128).abs() ** 4, dim=-1).float()
    features = [
        Features(seen.pixels[rows], of_points[seen.point[rows]], survey.colors[seen.point[rows]], seen.noise[rows])
        for rows in (seen.view == view for view in range(5))
    ]
    return replace(scene, observations=seen), features


def without(scene, rows):
    """The scene without some of its observations."""
    keep = ~rows
    return replace(scene, observations=scene.observations[keep], accepted=scene.accepted[keep])


def as_set(scene):
    seen = scene.observations
    return set(zip(seen.view.tolist(), seen.point.tolist(), seen.pixels[:, 0].tolist(), strict=True))


def test_observations_that_were_lost_are_found_again_and_no_others(known, draw):
    scene, features = known
    rows = draw.uniform(0.0, 1.0, len(scene.observations)) < 0.2
    count = torch.bincount(scene.observations.point[~rows], minlength=80)
    rows &= count[scene.observations.point] >= 2

    found = complete_tracks(without(scene, rows), features, 4.0)

    assert int(rows.sum()) > 10
    assert as_set(found) <= as_set(scene)
    assert len(found.observations) > len(scene.observations) - 0.1 * int(rows.sum())
    assert bool((found.observations.point.diff() >= 0).all())
    assert int(found.accepted.sum()) == int((~rows).sum())


def test_two_tracks_of_one_point_become_one(known):
    scene, features = known
    seen = scene.observations
    count = torch.bincount(seen.point)
    point = int((count >= 4).nonzero()[0, 0])
    rows = (seen.point == point).nonzero()[:, 0]
    parted = seen.point.clone()
    parted[rows[2:]] = 80
    order = parted.argsort(stable=True)
    twice = replace(
        scene,
        points=torch.cat((scene.points, scene.points[point][None])),
        colors=torch.cat((scene.colors, scene.colors[:1])),
        placed=torch.ones(81, dtype=torch.bool),
        observations=replace(seen, point=parted)[order],
        accepted=scene.accepted[order],
    )

    found = complete_tracks(twice, features, 4.0)

    assert int((found.observations.point == point).sum()) == int(count[point])
    assert not bool((found.observations.point == 80).any())


def test_what_looks_otherwise_or_lies_elsewhere_is_no_observation(known):
    scene, features = known
    rows = scene.observations.view == 4
    least = torch.bincount(scene.observations.point[~rows], minlength=80) >= 2
    rows &= least[scene.observations.point]
    strange = replace(features[4], descriptors=features[4].descriptors.roll(7, dims=1))
    far = replace(features[4], pixels=features[4].pixels + 3.0)

    for of_last in (strange, far):
        found = complete_tracks(without(scene, rows), [*features[:4], of_last], 4.0)
        assert int((found.observations.view == 4).sum()) <= int((~rows & (scene.observations.view == 4)).sum()) + 1
