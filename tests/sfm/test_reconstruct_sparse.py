"""The incremental reconstruction from verified pairs to a finished scene."""

from dataclasses import dataclass, replace

import pytest
import torch

import torchrefrac as tr
from torchrefrac.features import PairMatches, build_tracks
from torchrefrac.geometry import align_above_plane, align_similarity, split_heading
from torchrefrac.optim import LevenbergMarquardtOptions
from torchrefrac.recorder import SilentRecorder
from torchrefrac.scene import Cameras, Capture, Scene, WaterExtent
from torchrefrac.sfm import (
    NoInitialPairError,
    PairPose,
    PinholeInitializer,
    Pose,
    PoseInitializer,
    RefractiveInitializer,
    SfmOptions,
    VerifiedPair,
    reconstruct_sparse,
    verify_pairs,
)
from torchrefrac.sfm.pose import OneByOne

OPTIONS = SfmOptions()
HARD = {"noise": 0.1, "outliers": 0.05, "gravity_error_deg": 0.5}


@dataclass(frozen=True)
class Prepared:
    """What a reconstruction of a survey starts from, as the pipeline makes it."""

    scene: Scene
    capture: Capture
    pairs: list[VerifiedPair]
    initializer: PoseInitializer
    options: SfmOptions
    generator: torch.Generator

    @classmethod
    def of(cls, survey, options=OPTIONS, recorder=None) -> "Prepared":
        generator = torch.Generator().manual_seed(1)
        initializer = RefractiveInitializer(survey.capture, survey.basin.index_ratio, options)
        if survey.basin.index_ratio == 1.0:
            initializer = PinholeInitializer(survey.capture, options)
        features, recorder = survey.features(), recorder or SilentRecorder()
        pairs = verify_pairs(survey.pairs(), features, initializer, options.min_pair_inliers, generator, recorder)
        seen, colors = build_tracks(features, [pair.pair for pair in pairs])
        scene = Scene.of_capture(survey.capture, seen, colors, initializer.index_ratio)
        return cls(scene, survey.capture, pairs, initializer, options, generator)


def reconstruct(survey, options=OPTIONS, recorder=None) -> Scene:
    """From the matches of a survey to the scene."""
    given = Prepared.of(survey, options, recorder)
    return reconstruct_sparse(
        given.scene, given.capture, given.pairs, given.initializer, options, given.generator,
        recorder or SilentRecorder(),
    )  # fmt: skip


@pytest.mark.parametrize("index_ratio", [1.33, 1.0], ids=["water", "air"])
def test_cameras_are_recovered_to_a_millimetre_from_a_metre_away(survey_of, index_ratio):
    survey = survey_of(cameras=6, points=300, index_ratio=index_ratio, **HARD)

    result = reconstruct(survey)

    assert result.views.registered.all()
    assert result.failures == {}
    align = align_above_plane if index_ratio > 1.0 else align_similarity
    centers = align(result.views.center, survey.basin.center).apply(result.views.center)
    assert (centers - survey.basin.center).norm(dim=-1).amax() < 0.1


def test_points_are_recovered_with_their_colours_and_wrong_observations_are_left_out(survey_of):
    survey = survey_of(points=200, **HARD)

    result = reconstruct(survey)

    assert len(result.points) > 100
    track = result.colors[:, 0].long()  # a survey colours its points by their number
    points = align_above_plane(result.views.center, survey.basin.center).apply(result.points)
    distance = (points - survey.basin.points[track]).norm(dim=-1)
    assert distance.median() < 0.5
    assert (distance < 2.0).double().mean() > 0.97
    errors = result.errors()
    assert errors.amax() < OPTIONS.max_error
    assert errors.square().mean().sqrt() < 0.2


def test_a_finished_point_is_seen_by_three_images_at_least_and_observations_are_sorted(survey_of):
    result = reconstruct(survey_of(**HARD, points=120))

    assert torch.bincount(result.observations.point).amin() >= 3
    order = result.observations.point * len(result.views) + result.observations.view
    assert (order[1:] > order[:-1]).all()
    assert torch.equal(result.observations.point.unique(), torch.arange(len(result.points)))


def test_the_result_stands_in_the_frame_of_the_first_camera_and_its_measured_height(survey_of):
    result = reconstruct(survey_of(**HARD, points=120))

    assert result.views.center[0].tolist() == pytest.approx([0.0, 0.0, 30.0], abs=1e-9)
    assert float(split_heading(result.views.rotation[0])[1]) == pytest.approx(0.0, abs=1e-9)
    assert float(result.views.center[1, 2]) == pytest.approx(40.0, abs=0.2)


def test_land_and_water_are_reconstructed_together(survey_of):
    survey = survey_of(points=200, land=60, noise=0.1, gravity_error_deg=0.5)

    result = reconstruct(survey, replace(OPTIONS, min_track_length=2))

    assert result.views.registered.all()
    points = align_above_plane(result.views.center, survey.basin.center).apply(result.points)
    track = result.colors[:, 0].long()
    dry = survey.basin.points[track, 2] > 0.0
    distance = (points - survey.basin.points[track]).norm(dim=-1)
    assert dry.sum() > 20
    assert distance[dry].median() < 0.1
    assert distance[~dry].median() < 0.2


def test_many_images_are_registered_in_rounds_and_adjusted_locally_as_exactly(survey_of, recorder):
    survey = survey_of(cameras=9, points=200, **HARD)

    result = reconstruct(survey, replace(OPTIONS, many_images=4, global_growth=1.5), recorder)

    after_rounds = [int(step) for name, _, step in recorder.scalars if name == "registration/images"]
    assert after_rounds == [3, 4, 6, 9]
    assert result.views.registered.all()
    centers = align_above_plane(result.views.center, survey.basin.center).apply(result.views.center)
    assert (centers - survey.basin.center).norm(dim=-1).amax() < 0.1


def test_two_images_are_enough(survey_of):
    survey = survey_of(cameras=2, points=150, noise=0.1)

    result = reconstruct(survey)

    assert result.views.registered.all()
    assert len(result.points) > 100


def test_an_image_that_sees_nothing_of_the_scene_is_reported_with_the_reason(survey_of):
    survey = _without(survey_of(points=150, noise=0.1), image=2)

    result = reconstruct(survey)

    assert result.views.registered.tolist() == [True, True, False, True]
    assert result.failures == {"2.jpg": "sees only 0 reconstructed points, of which a pose needs 20"}
    assert torch.equal(result.views.rotation[2], torch.eye(3, dtype=torch.float64))
    assert not (result.observations.view == 2).any()


def test_an_image_whose_matches_are_all_wrong_is_left_out_and_does_no_harm(survey_of, draw):
    survey = survey_of(points=150, noise=0.1)
    last = survey.seen.view == 3
    pixels = survey.seen.pixels.clone()
    pixels[last] = draw.uniform(0.0, 768.0, int(last.sum()), 2)

    result = reconstruct(replace(survey, seen=replace(survey.seen, pixels=pixels)))

    assert result.views.registered.tolist() == [True, True, True, False]
    assert "3.jpg" in result.failures
    there = result.views.registered
    found, truth = result.views.center[there], survey.basin.center[there]
    assert (align_above_plane(found, truth).apply(found) - truth).norm(dim=-1).amax() < 0.5


def test_an_image_that_was_refused_is_tried_again_when_it_sees_more_points(survey_of, generator):
    survey = survey_of(points=150)
    initializer = _Knowing(survey)
    pose = PairPose(survey.basin.rotation[:2], survey.basin.center[:2], torch.ones(50, dtype=torch.bool), 0.5)
    pair = VerifiedPair(PairMatches(0, 1, torch.zeros(50, 2, dtype=torch.long)), pose, 50)

    result = reconstruct_sparse(
        survey.tracks(), survey.capture, [pair], initializer, OPTIONS, generator, SilentRecorder()
    )

    assert initializer.asked.count(initializer.asked[0]) == 2
    assert result.views.registered.all()
    assert result.failures == {}


@pytest.mark.parametrize("index_ratio", [1.33, 1.0], ids=["water", "air"])
def test_the_verbs_in_a_loop_of_ones_own_find_the_same_cameras(survey_of, index_ratio):
    """The incremental order of the verbs, in public names only."""
    survey = survey_of(cameras=5, points=200, index_ratio=index_ratio, noise=0.1, gravity_error_deg=0.5)
    expected = reconstruct(survey, replace(OPTIONS, min_track_length=2))

    scene = incremental(Prepared.of(survey))

    assert scene.views.registered.all()
    align = align_above_plane if index_ratio > 1.0 else align_similarity
    found = align(scene.views.center, expected.views.center).apply(scene.views.center)
    torch.testing.assert_close(found, expected.views.center, rtol=0.0, atol=1e-6)
    assert torch.equal(scene.trimmed().observations.pixels, expected.observations.pixels)


def incremental(given):
    """The scene from the best pair and then one view after the other, adjusted whenever it has grown by a tenth."""

    def gravity(part):
        if part.scene.index_ratio == 1.0:
            return []
        return [tr.bundle.GravityPrior(given.capture.down_in_cam[part.view], given.capture.down_sigma[part.view])]

    rules = given.options.rules(given.initializer, gravity, given.generator)
    solver = LevenbergMarquardtOptions(max_iterations=10, function_tolerance=1e-4)
    growing = replace(rules, bundle=replace(rules.bundle, solver=solver))
    scene, outcome = tr.sfm.start(given.scene, max(given.pairs, key=lambda pair: len(pair.pair)), rules)
    assert outcome.done
    scene = grown(scene, growing, rules)
    while not scene.views.registered.all():
        visible = torch.bincount(scene.observations.view[scene.placed[scene.observations.point]])
        scene, outcome = tr.sfm.register(scene, int(visible.masked_fill(scene.views.registered, -1).argmax()), rules)
        assert outcome.done, outcome
        scene, _ = tr.sfm.triangulate(scene, rules)
        scene = grown(scene, growing, rules)
    for _ in range(given.options.final_rounds):
        scene, _ = tr.sfm.triangulate(scene, rules)
        scene, _ = tr.sfm.filter_points(scene, rules)
        scene, outcome = tr.sfm.adjust(scene, rules)
        rules = replace(rules, bundle=tr.sfm.with_noise_found(given.options.bundle, outcome.report))
    return tr.sfm.filter_points(scene, rules)[0]


def grown(scene, growing, rules):
    scene, _ = tr.sfm.adjust(scene, growing)
    scene, _ = tr.sfm.filter_points(scene, rules)
    return tr.sfm.triangulate(scene, rules)[0]


def test_in_air_gravity_takes_no_part_in_the_adjustment(survey_of):
    survey = survey_of(cameras=3, points=100, noise=1.0, index_ratio=1.0)
    sure = replace(survey, capture=replace(survey.capture, down_sigma=torch.full_like(survey.capture.height, 1e-8)))

    with_gravity, without = reconstruct(sure), reconstruct(survey)

    assert torch.equal(with_gravity.views.rotation, without.views.rotation)


def test_the_capture_comes_with_the_scene(survey_of):
    survey = survey_of(cameras=3, points=100, noise=0.1)

    assert reconstruct(survey).capture is survey.capture


def test_without_a_pair_there_is_nothing_to_start_from(survey_of, generator):
    survey = survey_of(cameras=3)
    initializer = RefractiveInitializer(survey.capture, survey.basin.index_ratio, OPTIONS)

    with pytest.raises(NoInitialPairError, match="none of 0 image pairs has enough matches and angle to start from"):
        reconstruct_sparse(survey.tracks(), survey.capture, [], initializer, OPTIONS, generator, SilentRecorder())


def test_pairs_whose_rays_open_too_little_cannot_start(survey_of):
    survey = survey_of(cameras=2, points=150)

    with pytest.raises(NoInitialPairError, match="none of 1 image pairs"):
        reconstruct(survey, replace(OPTIONS, min_angle_deg=80.0))


def test_the_same_seed_gives_the_same_reconstruction_to_the_last_bit(survey_of):
    survey = survey_of(cameras=3, points=100, **HARD)

    one, two = (reconstruct(survey) for _ in range(2))

    assert torch.equal(one.views.center, two.views.center)
    assert torch.equal(one.points, two.points)
    assert torch.equal(one.observations.view, two.observations.view)


def test_the_radial_terms_of_a_wrong_lens_are_refined_on_request(survey_of):
    survey = survey_of(points=200, noise=0.05, distortion=(-0.05, 0.02, 0.0, 0.0, 0.0))
    wrong = replace(survey.capture.cameras[0], distortion=survey.capture.cameras[0].distortion * 0.8)
    survey = replace(survey, capture=replace(survey.capture, cameras=Cameras.of([wrong])))
    refine = replace(OPTIONS, bundle=replace(OPTIONS.bundle, refine=("radial",)))

    given, refined = reconstruct(survey), reconstruct(survey, refine)

    assert torch.equal(given.intrinsics.distortion, wrong.distortion)
    assert float(refined.intrinsics.distortion[0]) == pytest.approx(-0.05, abs=2e-3)
    assert refined.errors().square().mean() < 0.5 * given.errors().square().mean()


def test_the_recorder_hears_of_every_image_and_of_the_cost_in_order(survey_of, recorder):
    reconstruct(survey_of(points=100, noise=0.1), recorder=recorder)

    images = [value for name, value, _ in recorder.scalars if name == "registration/images"]
    steps = [step for name, _, step in recorder.scalars if name == "adjustment/cost"]
    assert images == [3, 4]
    assert len(steps) > 0
    assert steps == list(range(len(steps)))
    damping = [(value, step) for name, value, step in recorder.scalars if name == "adjustment/damping"]
    assert [step for _, step in damping] == steps
    assert all(value > 0.0 for value, _ in damping)


def test_the_recorder_hears_how_many_points_agree_with_each_new_pose(survey_of, recorder):
    reconstruct(survey_of(points=100, noise=0.1, outliers=0.1), recorder=recorder)

    told = {name: [v for n, v, _ in recorder.scalars if n == name] for name, _, _ in recorder.scalars}
    assert len(told["registration/inliers"]) == len(told["registration/images"]) == 2
    assert all(value >= 20 for value in told["registration/inliers"])
    assert all(0.5 < value <= 1.0 for value in told["registration/inlier_ratio"])


def test_residuals_and_points_are_shown_after_every_adjustment_of_everything(survey_of):
    pictures = Pictures()

    reconstruction = reconstruct(survey_of(points=100, noise=0.1), recorder=pictures)

    assert [step for _, step in pictures.histograms] == [step for _, step in pictures.clouds]
    assert [step for _, step in pictures.clouds] == list(range(len(pictures.details) + 1))
    values, _ = pictures.histograms[-1]
    assert torch.equal(values, reconstruction.errors())
    points, _ = pictures.clouds[-1]
    assert torch.equal(points, reconstruction.points)
    assert all(text.startswith("adjusted ") and " iterations, " in text for text in pictures.details)


class Pictures(SilentRecorder):
    """Keeps histograms, clouds and details."""

    wants_pictures = True

    def __init__(self):
        self.histograms, self.clouds, self.details = [], [], []

    def histogram(self, name, values, step):
        self.histograms.append((values, step))

    def cloud(self, name, points, colors, step):
        assert len(points) == len(colors)
        self.clouds.append((points, step))

    def detail(self, text):
        self.details.append(text)


class _Knowing(OneByOne, PoseInitializer):
    """An initialiser that knows the true poses, but finds none when it is first asked."""

    def __init__(self, survey):
        self.basin, self.asked = survey.basin, []

    @property
    def index_ratio(self):
        return self.basin.index_ratio

    def absolute(self, image, generator):
        number, _, pixels, _ = image
        self.asked.append(number)
        if len(self.asked) == 1:
            return None
        everything = torch.ones(len(pixels), dtype=torch.bool)
        return Pose(self.basin.rotation[number], self.basin.center[number], everything)


def _without(survey, image):
    """The survey where `image` sees nothing."""
    rows = survey.seen.view != image
    return replace(survey, seen=survey.seen[rows], wrong=survey.wrong[rows])


@pytest.mark.parametrize("stated", ["not", *(pytest.param(how, marks=pytest.mark.slow) for how in ("above", "drawn"))])
def test_a_shore_that_lies_below_the_water_is_placed_where_it_is(survey_of, draw, stated):
    survey = survey_of(cameras=5, points=240)
    scene = survey.scene(with_points=True)
    dry = scene.points[:, 0] > scene.points[:, 0].quantile(0.7)
    pixels, _ = replace(scene, dry=dry).cameras_of(survey.seen).project(scene.points[survey.seen.point])
    seen = replace(survey.seen, pixels=pixels + 0.1 * draw.normal(len(pixels), 2))
    everywhere = torch.tensor([(-1e4, -1e4), (1e4, -1e4), (1e4, 1e4), (-1e4, 1e4)], dtype=torch.float64)
    extent = {
        "not": None,
        "above": WaterExtent(3e4 + everywhere),  # no point lies in it: every track must speak for itself
        "drawn": WaterExtent(None, (None, everywhere, None, None, None)),
    }[stated]
    survey = replace(survey, seen=seen, capture=replace(survey.capture, water_extent=extent))

    result = reconstruct(survey)

    centers = align_above_plane(result.views.center, survey.basin.center).apply(result.views.center)
    assert (centers - survey.basin.center).norm(dim=-1).amax() < 0.2
    number = result.colors[:, 0].long() + 256 * result.colors[:, 1].long()
    assert (result.outside_water() == dry[number]).double().mean() > 0.95
    assert int(result.outside_water().sum()) > 30
    assert (result.assessment.disputed == (0, 0)) == (stated == "not")
