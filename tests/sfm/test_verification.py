"""Which matches of a pair agree on a pose."""

from dataclasses import replace

import torch

from torchrefrac.features import PairMatches
from torchrefrac.geometry import Rigid
from torchrefrac.recorder import SilentRecorder
from torchrefrac.sfm import PairPose, RefractiveInitializer, SfmOptions, errors_are_rough, verify_pairs
from torchrefrac.sfm.pose import OneByOne, judge_pair


class Agreeing(OneByOne):
    """An initialiser for which the first `inliers` matches of any pair agree, and the last `straight` if nothing is
    bent; keeps the pixels it was given."""

    index_ratio = 1.333

    def __init__(self, inliers, straight=0):
        self.inliers, self.straight, self.asked = inliers, straight, []

    def relative(self, images, pixels, generator):
        self.asked.append((images, pixels))
        if self.inliers is None:
            return None
        number = torch.arange(len(pixels[0]))
        return PairPose(None, None, number < self.inliers, 0.1, number >= len(number) - self.straight)

    def absolute(self, image, generator):
        raise AssertionError("nobody asks for one view")


def test_the_matches_that_agree_are_kept(survey_of, generator):
    survey = survey_of(cameras=2)

    (verified,) = verify_pairs(survey.pairs(), survey.features(), Agreeing(25), 20, generator, SilentRecorder())

    (pair,) = survey.pairs()
    assert (verified.pair.first, verified.pair.second, verified.num_putative) == (0, 1, len(pair))
    assert torch.equal(verified.pair.matches, pair.matches[:25])


def test_matches_that_agree_if_seen_straight_are_kept_where_they_are_many(survey_of, generator):
    survey = survey_of(cameras=2)
    (pair,) = survey.pairs()

    for straight, kept in ((19, 25), (20, 45)):
        (verified,) = verify_pairs(
            survey.pairs(), survey.features(), Agreeing(25, straight), 20, generator, SilentRecorder()
        )
        rows = [*range(25), *range(len(pair) - 20, len(pair))][:kept]
        assert torch.equal(verified.pair.matches, pair.matches[rows])


def test_errors_are_rough_where_clearly_more_matches_agree_within_a_wider_limit(survey_of, generator):
    survey = survey_of(cameras=3)
    matches, features = survey.pairs(), survey.features()
    verified = verify_pairs(matches, features, Agreeing(20), 20, generator, SilentRecorder())

    for agreeing, rough in ((None, False), (20, False), (22, False), (23, True)):
        assert errors_are_rough(matches, verified, features, Agreeing(agreeing)) is rough


def test_those_pairs_show_whether_errors_are_rough_in_which_most_matches_do_not_agree(survey_of, generator):
    survey = survey_of(cameras=4)
    matches, features = survey.pairs(), survey.features()
    verified = verify_pairs(matches, features, Agreeing(20), 20, generator, SilentRecorder())
    left = [len(one) - 20 for one in matches]
    wide = Agreeing(100)

    errors_are_rough(matches, verified, features, wide)

    asked = {images for images, _ in wide.asked}
    most = sorted(range(len(matches)), key=lambda i: -left[i])[:3]
    assert asked == {(matches[i].first, matches[i].second) for i in most}


def test_rough_options_take_the_larger_limit_and_remember_the_smaller():
    rough = SfmOptions(max_error=3.0, rough_error=12.0).rough
    assert (rough.max_error, rough.ransac.max_error, rough.least_error) == (12.0, 12.0, 3.0)
    assert SfmOptions(max_error=20.0).rough.max_error == 20.0


def test_matches_of_dry_points_are_told_from_those_that_agree_through_water(survey_of):
    survey = survey_of(cameras=2, points=300)
    scene, truth = survey.scene(with_points=True), torch.arange(300) % 3 == 0
    seen = scene.observations
    pixels, _ = replace(scene, dry=truth).cameras_of(seen).project(scene.points[seen.point])
    both = tuple(pixels[seen.view == view] for view in (0, 1))
    dry, pose = truth[seen.point[seen.view == 0]], Rigid(scene.views.rotation, scene.views.center)
    ratio = torch.tensor(scene.index_ratio, dtype=torch.float64)

    found = judge_pair(pose, both, scene.intrinsics, ratio, 0.5)
    stated = judge_pair(pose, both, scene.intrinsics, ratio, 0.5, dry)

    assert found.inliers[~dry].all()
    assert found.inliers[dry].double().mean() < 0.5
    assert torch.equal(found.straight, ~found.inliers)
    assert stated.inliers.all()


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


def test_what_comes_out_for_a_pair_does_not_depend_on_the_others(survey_of):
    survey = survey_of(cameras=3)
    initializer = RefractiveInitializer(survey.capture, 1.333, SfmOptions())

    def verified(pairs):
        chance = torch.Generator().manual_seed(5)
        found = verify_pairs(pairs, survey.features(), initializer, 20, chance, SilentRecorder())
        return {(one.pair.first, one.pair.second): one for one in found}

    all_three, alone = verified(survey.pairs()), verified(survey.pairs()[2:])

    assert len(all_three) == 3
    (key,) = alone
    torch.testing.assert_close(alone[key].pose.rotation, all_three[key].pose.rotation, rtol=0.0, atol=1e-9)
    assert torch.equal(alone[key].pair.matches, all_three[key].pair.matches)
