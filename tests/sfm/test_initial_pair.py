"""The pair that the reconstruction grows from."""

import math

import torch

from torchrefrac.features import PairMatches
from torchrefrac.sfm import PairPose, Rules, SfmOptions, Start, VerifiedPair, start
from torchrefrac.sfm.register import rank_initial_pairs

OPTIONS = SfmOptions(min_initial_angle_deg=5.0)
ROTATION, CENTER = torch.zeros(2, 3, 3), torch.zeros(2, 3)


def _pair(first, matches, angle_deg, rotation=ROTATION, center=CENTER):
    pose = PairPose(rotation, center, torch.ones(matches, dtype=torch.bool), math.radians(angle_deg))
    return VerifiedPair(PairMatches(first, first + 1, torch.zeros(matches, 2, dtype=torch.long)), pose, matches)


def test_wide_pairs_come_first_by_their_matches_then_narrow_ones_by_their_angle():
    pairs = [_pair(0, 900, 1.0), _pair(1, 100, 20.0), _pair(2, 300, 6.0), _pair(3, 500, 4.9), _pair(4, 200, 60.0)]

    ranked = rank_initial_pairs(pairs, OPTIONS)

    assert [pair.pair.first for pair in ranked] == [2, 4, 1, 3, 0]


def test_pairs_whose_matches_determine_no_pose_are_left_out():
    pairs = [_pair(0, 900, 0.0, None, None), _pair(1, 100, 20.0)]

    assert [pair.pair.first for pair in rank_initial_pairs(pairs, OPTIONS)] == [1]


def test_no_pairs_are_ranked_as_none():
    assert rank_initial_pairs([], OPTIONS) == []


def test_a_scene_starts_with_the_two_views_and_the_points_that_both_see(survey_of):
    survey = survey_of()
    pair = _pair(1, 50, 20.0, survey.basin.rotation[1:3], survey.basin.center[1:3])

    scene, outcome = start(survey.tracks(), pair, Rules())

    assert scene.views.registered.tolist() == [False, True, True, False]
    seen = scene.observations
    both = torch.bincount(seen.point[scene.views.registered[seen.view]], minlength=60) == 2
    assert torch.equal(scene.placed, both)
    torch.testing.assert_close(scene.points[both], survey.basin.points[both], rtol=0.0, atol=1e-7)
    assert torch.equal(scene.views.rotation[1:3], survey.basin.rotation[1:3])
    assert outcome.kind is Start.DONE
    assert str(outcome) == f"{int(both.sum())} points are placed from the first two views"


def test_a_pair_without_a_pose_starts_nothing(survey_of):
    scene = survey_of().tracks()

    same, outcome = start(scene, _pair(1, 50, 20.0, None, None), Rules())

    assert same is scene
    assert outcome.kind is Start.NO_POSE
    assert str(outcome) == "the matches of the pair do not determine its pose"


def test_a_pair_that_few_points_can_be_placed_from_says_how_many(survey_of):
    survey = survey_of(cameras=2, points=9)

    _, outcome = start(survey.tracks(), _pair(0, 9, 20.0, survey.basin.rotation, survey.basin.center), Rules())

    assert outcome.kind is Start.FEW_POINTS
    assert str(outcome) == "only 9 points can be placed from the pair, of which a start needs 12"
    assert not outcome.done
