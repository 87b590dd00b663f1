"""Which matches of a pair agree on a pose."""

import torch

from torchrefrac.features import PairMatches
from torchrefrac.recorder import SilentRecorder
from torchrefrac.sfm import PairPose, verify_pairs


class Agreeing:
    """An initialiser for which the first `inliers` matches of any pair agree; keeps the pixels it was given."""

    def __init__(self, inliers):
        self.inliers, self.asked = inliers, []

    def relative(self, images, pixels, generator):
        self.asked.append((images, pixels))
        if self.inliers is None:
            return None
        return PairPose(None, None, torch.arange(len(pixels[0])) < self.inliers, 0.1)


def test_the_matches_that_agree_are_kept(survey_of, generator):
    survey = survey_of(cameras=2)

    (verified,) = verify_pairs(survey.pairs(), survey.features(), Agreeing(25), 20, generator, SilentRecorder())

    (pair,) = survey.pairs()
    assert (verified.pair.first, verified.pair.second, verified.num_putative) == (0, 1, len(pair))
    assert torch.equal(verified.pair.matches, pair.matches[:25])


def test_the_initialiser_is_given_the_pixels_of_both_keypoints(survey_of, generator):
    survey = survey_of(cameras=2)
    initializer = Agreeing(25)

    verify_pairs(survey.pairs(), survey.features(), initializer, 20, generator, SilentRecorder())

    ((images, (first, second)),) = initializer.asked
    expected_first, expected_second, _, _ = survey.common(0, 1)
    assert images == (0, 1)
    assert torch.equal(first, expected_first)
    assert torch.equal(second, expected_second)


def test_pairs_with_too_few_matches_are_not_even_tried(survey_of, generator):
    survey = survey_of(cameras=2)
    (pair,) = survey.pairs()
    initializer = Agreeing(25)

    few = PairMatches(0, 1, pair.matches[:19])
    verified = verify_pairs([few], survey.features(), initializer, 20, generator, SilentRecorder())

    assert verified == initializer.asked == []


def test_pairs_with_too_few_inliers_or_without_a_pose_are_dropped(survey_of, generator):
    survey = survey_of(cameras=2)

    for inliers in (19, None):
        verified = verify_pairs(survey.pairs(), survey.features(), Agreeing(inliers), 20, generator, SilentRecorder())
        assert verified == []


def test_the_recorder_hears_of_the_inliers_of_every_pair(survey_of, generator, recorder):
    survey = survey_of(cameras=3)

    verify_pairs(survey.pairs(), survey.features(), Agreeing(25), 20, generator, recorder)

    inliers = [(value, step) for name, value, step in recorder.scalars if name == "verification/inliers"]
    assert inliers == [(25, 0), (25, 1), (25, 2)]
