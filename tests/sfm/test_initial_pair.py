"""The pair that the reconstruction grows from."""

import math

import torch

from torchrefrac.features import PairMatches
from torchrefrac.sfm import PairPose, SfmOptions, VerifiedPair
from torchrefrac.sfm.initial_pair import rank_initial_pairs, start_from_pair

OPTIONS = SfmOptions(min_initial_angle_deg=5.0)
ANY = torch.zeros(2, 3)


def _pair(first, matches, angle_deg, rotation=ANY, center=ANY):
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


def test_a_model_starts_with_the_two_images_and_the_points_that_both_see(survey_of):
    survey = survey_of()
    pair = _pair(1, 50, 20.0, survey.basin.rotation[1:3], survey.basin.center[1:3])

    model = start_from_pair(pair, survey.tracks, survey.capture, survey.index_ratio, OPTIONS)

    assert model.registered.tolist() == [False, True, True, False]
    both = torch.bincount(survey.tracks.track[model.visible()], minlength=60) == 2
    assert torch.equal(model.has_point, both)
    torch.testing.assert_close(model.points[both], survey.basin.points[both], rtol=0.0, atol=1e-7)
    assert torch.equal(model.rotation[1:3], survey.basin.rotation[1:3])
