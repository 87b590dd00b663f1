"""Adjustments of some views, the rest of a scene staying as it is."""

from dataclasses import replace

import pytest
import torch

from torchrefrac.bundle import BundleOptions
from torchrefrac.geometry import so3_exp
from torchrefrac.optim import LevenbergMarquardtOptions
from torchrefrac.sfm.adjust import adjust_locally, with_neighbours

OPTIONS = BundleOptions(solver=LevenbergMarquardtOptions(function_tolerance=1e-14))
MOVED = torch.tensor((2, 5))
ELSEWHERE = 150  # the first of the points that these views do not see


@pytest.fixture
def survey(survey_of):
    return survey_of(cameras=8, points=200)


@pytest.fixture
def truth(survey):
    """The true scene, in which two of the views do not see the last points."""
    scene = survey.scene(with_points=True)
    seen = scene.observations
    keep = ~_mask(MOVED)[seen.view] | (seen.point < ELSEWHERE)
    return replace(scene, observations=seen[keep], accepted=scene.accepted[keep])


def _mask(views):
    return torch.zeros(8, dtype=torch.bool).index_fill(0, torch.as_tensor(views), True)


def test_views_come_to_where_the_others_have_them_and_nothing_else_moves(truth, survey, rules_of, draw):
    turned = so3_exp(torch.deg2rad(0.2 * draw.directions(2))) @ truth.views.rotation[MOVED]
    moved = truth.views.center[MOVED] + 0.5 * draw.directions(2)
    shaken = replace(truth, views=truth.views.at(turned, moved, MOVED))
    refining = replace(OPTIONS, refine=("index_ratio", "focal"))

    found, outcome = adjust_locally(shaken, rules_of(survey, refining), _mask(MOVED))

    assert outcome.done
    others = ~_mask(MOVED)
    torch.testing.assert_close(found.views.center, truth.views.center, rtol=0.0, atol=1e-4)
    torch.testing.assert_close(found.points, truth.points, rtol=0.0, atol=1e-3)
    assert torch.equal(found.views.center[others], truth.views.center[others])
    assert torch.equal(found.views.rotation[others], truth.views.rotation[others])
    assert torch.equal(found.points[ELSEWHERE:], truth.points[ELSEWHERE:])
    assert found.cameras is shaken.cameras
    assert found.interfaces is shaken.interfaces


def test_neighbours_are_the_views_that_support_most_of_the_same_points(truth):
    seen = truth.observations
    mine = seen.point[seen.view == 3].unique()
    shared = [int(torch.isin(seen.point[seen.view == view], mine).sum()) if view != 3 else -1 for view in range(8)]

    some = with_neighbours(truth, _mask([3]), least=2)

    best = sorted(range(8), key=lambda view: shared[view])[-2:]
    assert int(some.sum()) == 3
    assert bool(some[3])
    assert min(shared[view] for view in some.nonzero()[:, 0].tolist() if view != 3) == min(shared[v] for v in best)


def test_views_that_share_nothing_are_no_neighbours(truth):
    alone = replace(truth, accepted=truth.observations.view == 3)

    assert with_neighbours(alone, _mask([3]), least=4).nonzero()[:, 0].tolist() == [3]
