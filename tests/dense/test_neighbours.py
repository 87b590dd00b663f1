"""Which images go together, and how far away their surfaces lie."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.optimize import brentq

from torchrefrac.camera import Intrinsics
from torchrefrac.dense.neighbours import MARGIN, find_neighbours
from torchrefrac.dense.options import DenseOptions
from torchrefrac.geometry import Rigid
from torchrefrac.scene import Interfaces, Observations, Scene

OPTIONS = DenseOptions(method="patch")
INDEX = 1.33


@pytest.fixture
def make_row(draw):
    """`make_row(places)`: cameras that look down from 50 above the water, at these x, y = 0; 40 points around the
    origin, between 15 and 25 deep, all of them observed by all cameras."""

    def make(places, low=-25.0, high=-15.0, count=40):
        m = len(places)
        center = torch.tensor([(x, 0.0, 50.0) for x in places], dtype=torch.float64)
        points = torch.cat((draw.uniform(-10.0, 10.0, count, 2), draw.uniform(low, high, count, 1)), dim=-1)
        view, point = torch.arange(m).repeat(count), torch.arange(count).repeat_interleave(m)
        return Scene.create(
            Rigid(torch.tensor(np.diag((1.0, -1.0, -1.0))).expand(m, 3, 3), center),
            Intrinsics.create(2000, 2000, 500.0),
            Interfaces.level(INDEX),
            points,
            Observations(view, point, torch.zeros(m * count, 2, dtype=torch.float64)),
        )

    return make


def _observed(scene, keep):
    """With some of the observations (N)."""
    return replace(scene, observations=scene.observations[keep], accepted=scene.accepted[keep])


def _worth(scene, one, other):
    """Sum over the common points of how well the angle fits, by plain trigonometry."""
    total = 0.0
    seen = [set(scene.observations.point[scene.observations.view == i].tolist()) for i in (one, other)]
    for point in seen[0] & seen[1]:
        to = [(scene.views.center[i] - scene.points[point]).numpy() for i in (one, other)]
        cosine = to[0] @ to[1] / np.linalg.norm(to[0]) / np.linalg.norm(to[1])
        angle = np.degrees(np.arccos(min(cosine, 1.0)))
        if 1.0 < angle < OPTIONS.angle_max:
            total += min(angle / OPTIONS.angle_best, OPTIONS.angle_best / angle)
    return total


def _path_length(center, point):
    """From the water's surface to a point, along the ray that obeys Snell's law, by bisection; negative above it."""
    reach = np.hypot(*(point - center)[:2])
    if point[2] > 0.0:
        whole = np.hypot(reach, center[2] - point[2])
        return whole - whole * center[2] / (center[2] - point[2])

    def mismatch(at):
        return at / np.hypot(at, center[2]) - INDEX * (reach - at) / np.hypot(reach - at, point[2])

    at = brentq(mismatch, 0.0, reach, xtol=1e-13)
    return np.hypot(reach - at, point[2])


def test_others_come_in_the_order_of_their_worth(make_row, generator):
    scene = make_row((0.0, 1.5, 12.0, 22.0, 28.0, -55.0, 300.0))
    kept = torch.rand(len(scene.observations), generator=generator) < 0.7
    scene = _observed(scene, kept)

    found = find_neighbours(scene, OPTIONS)

    for image in range(7):
        worth = {other: _worth(scene, image, other) for other in range(7) if other != image}
        expected = sorted((other for other in worth if worth[other] > 0.0), key=lambda other: -worth[other])
        assert (found[image].ids[1:].tolist() if image in found else []) == expected
    assert 6 not in found[0].ids[1:]
    assert found[0].ids[1:][0] in (3, 4)


def test_no_more_than_the_wanted_neighbours(make_row):
    scene = make_row(tuple(6.0 * i for i in range(8)))

    every, few = (
        find_neighbours(scene, OPTIONS),
        find_neighbours(scene, replace(OPTIONS, neighbours=3)),
    )

    assert len(every[0].ids[1:]) == 7
    for image in range(8):
        assert torch.equal(few[image].ids[1:], every[image].ids[1:][:3])


def test_images_without_a_pose_are_nobodys_neighbour(make_row):
    scene = make_row((0.0, 20.0, 30.0))

    found = find_neighbours(
        replace(scene, views=replace(scene.views, registered=torch.tensor([True, False, True]))), OPTIONS
    )

    assert {image: hood.ids[1:].tolist() for image, hood in found.items()} == {0: [2], 2: [0]}


@pytest.mark.parametrize("points", [0, 4])
def test_images_with_too_few_points_are_left_out(make_row, points):
    scene = make_row((0.0, 20.0, 30.0))
    scene = _observed(scene, (scene.observations.view != 1) | (scene.observations.point < points))

    found = find_neighbours(scene, OPTIONS)

    assert sorted(found) == [0, 2]
    assert (1 in found[0].ids[1:]) == (points > 0)


def test_images_in_one_place_are_no_neighbours(make_row):
    assert find_neighbours(make_row((0.0, 0.5, 0.0)), OPTIONS) == {}


def test_images_without_points_have_no_neighbours(make_row):
    assert find_neighbours(make_row((0.0, 20.0), count=0), OPTIONS) == {}


@pytest.mark.parametrize(("low", "high"), [(-25.0, -15.0), (-20.0, 10.0), (3.0, 20.0)])
def test_the_range_is_that_of_the_points_along_their_bent_rays_and_a_quarter_more(make_row, low, high):
    scene = make_row((0.0, 20.0), low, high, count=400)

    hood = find_neighbours(scene, OPTIONS)[0]

    lengths = [_path_length(scene.views.center[0].numpy(), point) for point in scene.points.numpy()]
    least, most = np.quantile(lengths, (0.01, 0.99))
    assert hood.near == pytest.approx(least - MARGIN * (most - least), rel=1e-9)
    assert hood.far == pytest.approx(most + MARGIN * (most - least), rel=1e-9)


def test_a_few_wild_points_do_not_widen_the_range(make_row):
    scene = make_row((0.0, 20.0), count=1000)
    points = scene.points.clone()
    points[:5, 2] = -900.0

    wild, tame = (find_neighbours(r, OPTIONS)[0] for r in (replace(scene, points=points), scene))

    assert wild.far < 1.1 * tame.far


def test_points_at_one_distance_still_have_a_range(make_row):
    hood = find_neighbours(make_row((0.0, 20.0), -20.0, -20.0), OPTIONS)[0]

    assert hood.near < 19.9
    assert hood.far > 20.3
