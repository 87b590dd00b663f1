"""Two reconstructions from the same tracks become one where something known in both ties them."""

from dataclasses import dataclass, replace

import pytest
import torch

from tests.sfm.test_reconstruct_sparse import OPTIONS
from torchrefrac.features import build_tracks
from torchrefrac.geometry import Similarity, align_above_plane, heading_rotation
from torchrefrac.recorder import SilentRecorder
from torchrefrac.scene import Capture, Observations, Scene, Survey
from torchrefrac.sfm import PinholeInitializer, RefractiveInitializer, join, reconstruct_sparse, verify_pairs
from torchrefrac.sfm.frame import transformed
from torchrefrac.sfm.outcome import Joining

JOINED = "3 images join by {common} images, 0 points and {positions} stated positions known in both"
LEVEL = 420.0  # of the water where positions count from
in_water_and_air = pytest.mark.parametrize("index_ratio", [1.33, 1.0], ids=["water", "air"])


@dataclass(frozen=True)
class Halves:
    """The true views 0 to 3 and 4 to 7 with the points that each half sees, the others in a frame of their own."""

    first: Scene
    second: Scene
    capture: Capture
    center: torch.Tensor
    points: torch.Tensor

    @classmethod
    def of(cls, survey, seen, points, own) -> "Halves":
        """seen: of tracks with these true points; own: which of them each half places."""
        tracks = Scene.of_capture(survey.capture, seen, torch.zeros(len(points), 3).to(torch.uint8), 1.0)
        tracks = replace(tracks, interfaces=survey.scene().interfaces, points=points)
        both = [half_of(tracks, survey, torch.arange(8) // 4 == half, own[half]) for half in (0, 1)]
        lift = 0.0 if survey.basin.index_ratio > 1.0 else 9.0
        shift = torch.tensor((70.0, -30.0, lift), dtype=torch.float64)
        turn = heading_rotation(torch.tensor(2.5, dtype=torch.float64))
        moved = transformed(both[1], Similarity(torch.tensor(0.3).double(), turn, shift))
        return cls(both[0], moved, survey.capture, survey.basin.center, points)

    def rules(self, index_ratio):
        """With poses that fit the model."""
        of = PinholeInitializer(self.capture, OPTIONS)
        return OPTIONS.rules(RefractiveInitializer(self.capture, index_ratio, OPTIONS) if index_ratio > 1.0 else of)

    def joined(self, index_ratio=1.33, capture=None):
        """The first with the second."""
        capture = capture or self.capture
        stated = Survey.empty(capture.names).beside(capture)
        return join(self.first, self.second, self.rules(index_ratio), capture, stated)

    def assert_whole(self, scene):
        """All views and points are where they truly are."""
        assert scene.views.registered.all()
        torch.testing.assert_close(scene.views.center, self.center, rtol=0.0, atol=0.02)
        off = (scene.points - self.points)[scene.placed].norm(dim=-1)
        assert off.median() < 0.02


def half_of(tracks, survey, views, own):
    """The true poses of some views, and those of their own points that two of them see."""
    which = views.nonzero()[:, 0]
    posed = tracks.views.at(survey.basin.rotation[which], survey.basin.center[which], which)
    scene = replace(tracks, views=posed)
    placed = own & (scene.sightings() >= 2)
    accepted = views[scene.observations.view] & placed[scene.observations.point]
    return replace(scene, placed=placed, accepted=accepted)


def sorted_observations(view, point, pixels):
    order = (point * 8 + view).argsort(stable=True)
    return Observations(view[order], point[order], pixels[order])


@pytest.fixture
def halves_with(survey_of):
    """`halves_with(common)`: two tracks for each point, one in each half; the `common` views see every other point
    as a part of the other half's. mistaken: pixels of those by one of the common views are of another pose."""

    def make(common=(), index_ratio=1.33, mistaken=None):
        survey = survey_of(cameras=8, points=160, index_ratio=index_ratio)
        seen, count = survey.seen, len(survey.basin.points)
        other = torch.isin(seen.view, torch.tensor(common, dtype=torch.long)) & (seen.point % 2 == 1)
        half = (seen.view // 4) ^ other.long()
        pixels = seen.pixels.clone()
        if mistaken is not None:
            rows = other & (seen.view == mistaken)
            turned = survey.basin.center.clone()
            turned[mistaken, :2] += 12.0
            wrong, _ = replace(survey.basin, center=turned).project()
            pixels[rows] = wrong[mistaken, seen.point[rows]]
        tracks, points = sorted_observations(seen.view, seen.point + count * half, pixels), survey.basin.points
        in_first = torch.arange(2 * count) < count
        return Halves.of(survey, tracks, points.repeat(2, 1), (in_first, ~in_first))

    return make


def stated(capture, center, views, sigma=0.02):
    """The capture with the positions of some views."""
    known = torch.isin(torch.arange(len(center)), torch.tensor(views))[:, None].expand(-1, 3)
    position = center + torch.tensor((0.0, 0.0, LEVEL))
    return replace(capture, position=position, position_sigma=torch.where(known, sigma, torch.inf).double())


@in_water_and_air
def test_views_that_see_points_of_both_give_their_place(halves_with, index_ratio):
    halves = halves_with((1,) if index_ratio > 1.0 else (1, 2), index_ratio)

    scene, outcome = halves.joined(index_ratio)

    assert outcome.done
    assert outcome.numbers["common"] == (1 if index_ratio > 1.0 else 2)
    halves.assert_whole(scene)
    first, second = torch.arange(8) < 4, torch.arange(8) >= 4
    assert (scene.supported_by(first) & scene.supported_by(second)).sum() >= 20


def test_in_air_one_view_of_both_leaves_the_scale_open(halves_with):
    scene, outcome = halves_with((1,), 1.0).joined(1.0)

    assert outcome.kind is Joining.SCALE_OPEN
    assert int(scene.views.registered.sum()) == 4


def test_views_that_contradict_each_other_join_nothing(halves_with):
    halves = halves_with((1, 2), mistaken=2)

    scene, outcome = halves.joined()

    assert outcome.kind is Joining.DISAGREEING
    assert outcome.numbers["common"] == 2
    assert scene is halves.first


def test_a_view_that_most_contradict_does_no_harm(halves_with):
    halves = halves_with((1, 2, 6), mistaken=2)

    scene, outcome = halves.joined()

    assert outcome.done
    assert (outcome.numbers["agreeing"], outcome.numbers["common"]) == (2, 3)
    halves.assert_whole(scene)


@in_water_and_air
def test_tracks_with_a_place_in_both_join_what_no_view_does(survey_of, index_ratio):
    survey = survey_of(cameras=8, points=200, index_ratio=index_ratio, outliers=0.0)
    seen, count = survey.seen, 200
    in_half = [torch.bincount(seen.point[seen.view // 4 == half], minlength=count) >= 2 for half in (0, 1)]
    tying = (in_half[0] & in_half[1]).nonzero()[:24, 0]
    few = torch.zeros(count, dtype=torch.bool).index_fill(0, tying, True)
    kept = ~few[seen.point] | ((seen.view + seen.point) % 4 < 3)  # no view sees all that are common
    seen = seen[kept]
    point = torch.where(few[seen.point], seen.point, seen.point + count * (seen.view // 4))
    tracks, every = sorted_observations(seen.view, point, seen.pixels), torch.ones(2 * count, dtype=torch.bool)
    halves = Halves.of(survey, tracks, survey.basin.points.repeat(2, 1), (every, every))
    most = max(int(torch.bincount(seen.view[few[seen.point]], minlength=8).max()), 1)
    assert most < 20

    scene, outcome = halves.joined(index_ratio)

    assert outcome.done
    assert outcome.numbers["common"] == 0
    assert outcome.numbers["points"] >= 20
    halves.assert_whole(scene)


@in_water_and_air
def test_two_positions_in_each_are_enough(halves_with, index_ratio):
    halves = halves_with((), index_ratio)

    scene, outcome = halves.joined(index_ratio, stated(halves.capture, halves.center, (0, 2, 4, 7)))

    assert outcome.done
    assert outcome.numbers["positions"] == 2
    halves.assert_whole(scene)


@pytest.mark.parametrize("views", [(0, 1, 2, 5), (0, 1, 2, 3)], ids=["one", "none"])
def test_one_position_or_none_does_not_say_where_the_other_is(halves_with, views):
    halves = halves_with()

    scene, outcome = halves.joined(capture=stated(halves.capture, halves.center, views))

    assert outcome.kind is (Joining.UNDETERMINED if 5 in views else Joining.NOTHING)
    assert scene is halves.first


def test_positions_along_one_vertical_do_not_say_it(halves_with):
    halves = halves_with()
    center = halves.center.clone()
    center[5:, :2] = center[4, :2]

    _, outcome = halves.joined(capture=stated(halves.capture, center, range(8)))

    assert outcome.kind is Joining.UNDETERMINED


def test_positions_that_put_the_water_elsewhere_join_nothing(halves_with):
    halves = halves_with()
    center = halves.center.clone()
    center[6, :2] += 60.0

    _, outcome = halves.joined(capture=stated(halves.capture, center, (0, 2, 4, 6)))

    assert outcome.kind is Joining.OTHER_LEVEL


def test_reconstructions_of_the_same_views_are_refused(halves_with):
    halves = halves_with()

    with pytest.raises(ValueError, match=r"other\.views"):
        join(halves.first, halves.first, halves.rules(1.33), halves.capture, Survey.empty(halves.capture.names))


class Lines(SilentRecorder):
    """Keeps what was said in detail."""

    def __init__(self):
        self.lines = []

    def detail(self, text):
        self.lines.append(text)


def grown(survey, matches):
    """The reconstruction from these matches, and what was said of joining."""
    options, generator, recorder = OPTIONS, torch.Generator().manual_seed(1), Lines()
    initializer, features = RefractiveInitializer(survey.capture, survey.basin.index_ratio, options), survey.features()
    pairs = verify_pairs(matches, features, initializer, options.min_pair_inliers, generator, recorder)
    seen, colors = build_tracks(features, [one.pair for one in pairs])
    scene = Scene.of_capture(survey.capture, seen, colors, initializer.index_ratio)
    scene = reconstruct_sparse(scene, survey.capture, pairs, initializer, options, generator, recorder)
    return scene, [line for line in recorder.lines if line.startswith("a reconstruction of")]


def in_groups(survey, last):
    """The matches of the views up to the `last` of the first group among each other, and of those after it."""
    return [one for one in survey.pairs() if (one.first <= last) == (one.second <= last)]


def test_groups_that_nothing_but_positions_ties_are_one_scene_as_exact_as_these(survey_of, draw):
    survey = survey_of(cameras=6, points=60, noise=0.1, gravity_error_deg=0.2)
    error = 0.05 * draw.normal(6, 3)
    capture = stated(survey.capture, survey.basin.center + error, range(6), sigma=0.05)

    scene, said = grown(replace(survey, capture=capture), in_groups(survey, last=2))

    assert scene.views.registered.all()
    assert scene.further == ()
    assert scene.failures == {}
    assert said == ["a reconstruction of 3 images beside one of 3: " + JOINED.format(common=0, positions=3)]
    true = survey.basin.center + torch.tensor((0.0, 0.0, LEVEL - scene.assessment.lowered_by))
    assert (scene.views.center - true).square().mean().sqrt() < 0.05
    assert scene.assessment.center_sigma is not None
    assert (scene.assessment.center_sigma < 0.1).all()


def test_a_photograph_between_makes_one_scene_of_both_groups(survey_of):
    """Half of its keypoints match the first group, the other half the second one."""
    survey = survey_of(cameras=7, points=120, noise=0.1, gravity_error_deg=0.2)
    pairs = []
    for one in in_groups(survey, last=3):
        half = one.matches[:, 1] % 2 == 0 if one.second == 3 else one.matches[:, 1] >= 0
        pairs.append(replace(one, matches=one.matches[half]))
    for one in survey.pairs():
        if one.first == 3 and one.second > 3:
            pairs.append(replace(one, matches=one.matches[one.matches[:, 0] % 2 == 1]))

    scene, said = grown(survey, pairs)

    assert scene.views.registered.all()
    assert scene.further == ()
    assert said == ["a reconstruction of 3 images beside one of 4: " + JOINED.format(common=1, positions=0)]
    change = align_above_plane(scene.views.center, survey.basin.center)
    assert (change.apply(scene.views.center) - survey.basin.center).norm(dim=-1).max() < 0.3


def test_a_group_that_positions_do_not_place_stays_apart_and_says_why(survey_of):
    survey = survey_of(cameras=6, points=60)
    capture = stated(survey.capture, survey.basin.center, (0, 1, 2, 4))

    scene, said = grown(replace(survey, capture=capture), in_groups(survey, last=2))

    (other,) = scene.further
    assert not (scene.views.registered & other.views.registered).any()
    assert scene.views.registered.sum() == other.views.registered.sum() == 3
    assert set(scene.failures) == {survey.capture.names[i] for i in (~scene.views.registered).nonzero()[:, 0].tolist()}
    assert all("state two in each that are apart" in why for why in (*scene.failures.values(), *said))
    assert other.failures == {}
