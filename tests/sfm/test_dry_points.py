"""Which tracks are seen straight, as their observations, their neighbours and the stated extent of the water say."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.optimize import least_squares

from torchrefrac.geometry import Similarity
from torchrefrac.scene import Scene, WaterExtent
from torchrefrac.sfm import Rules, filter_points, readjust, triangulate
from torchrefrac.sfm.dry_points import disputed, evidence, find_dry, stated_sides, with_dry

RULES = Rules(min_angle_deg=0.5)
NOISE = 0.1


@pytest.fixture
def table(survey_of, draw):
    """`table(share)`: a finished scene that takes all points for being in the water, and which of them are not: those
    with a large x."""

    def make(share=0.4, points=300, **options):
        survey = survey_of(cameras=6, points=points, noise=0.0, **options)
        scene = survey.scene(with_points=True)
        x = scene.points[:, 0]
        dry = x > x.quantile(1.0 - share)
        seen = scene.observations
        pixels, _ = replace(scene, dry=dry).cameras_of(seen).project(scene.points[seen.point])
        pixels = pixels + NOISE * draw.normal(len(seen), 2)
        scene = replace(scene, observations=replace(seen, pixels=pixels), placed=torch.zeros_like(scene.placed))
        scene, _ = triangulate(scene, RULES)
        return filter_points(scene, RULES)[0], dry

    return make


def test_nothing_is_dry_in_a_scene_that_is_all_under_water(table):
    scene, _ = table(share=0.0)
    assert find_dry(scene, RULES) is None


def test_wrong_matches_are_not_taken_for_dry_points(survey_of):
    scene = survey_of(cameras=6, points=400, noise=NOISE, outliers=0.1).scene()
    scene, _ = filter_points(triangulate(scene, RULES)[0], RULES)
    assert find_dry(scene, RULES) is None


@pytest.mark.parametrize("share", [0.1, 0.4, 0.9])
def test_dry_points_are_found_among_those_in_the_water(table, share):
    scene, truth = table(share)

    found = find_dry(scene, RULES)

    assert found is not None
    length = torch.bincount(scene.observations.point)
    wrong = (found != truth) & (length >= 3)
    assert int(wrong.sum()) <= 0.01 * len(truth)


def test_where_nothing_speaks_for_water_the_water_is_in_doubt_and_not_where_it_ends(table):
    assert find_dry(table(share=1.0)[0], RULES) is None


def test_in_air_there_is_nothing_to_find(survey_of):
    assert find_dry(survey_of(index_ratio=1.0).scene(with_points=True), RULES) is None


def test_points_that_change_sides_are_placed_anew_where_they_are(table):
    scene, truth = table()

    changed = with_dry(scene, truth)

    assert torch.equal(changed.placed, scene.placed & ~truth)
    assert not changed.accepted[truth[scene.observations.point]].any()
    placed, _ = triangulate(changed, RULES)
    assert placed.placed[truth].double().mean() > 0.9
    assert placed.errors()[placed.accepted].median() < 2.0 * NOISE
    assert int(with_dry(changed, None).placed[truth].sum()) == 0


def test_evidence_is_twice_the_log_of_the_ratio_of_students_likelihoods(table):
    """Against a search for the best place of each track in each medium, one by one."""
    scene, _ = table(points=24)
    wanted = torch.bincount(scene.observations.point) >= 3
    found = evidence(scene, wanted, RULES, NOISE)
    seen, limit = scene.observations, RULES.bundle.loss_scale

    def unlikelihood(track, dry):
        rows = (seen.point == track).nonzero()[:, 0]
        cameras = scene.camera_of(seen.view[rows])
        cameras = cameras.as_pinhole() if dry else cameras

        def errors(at):
            return (cameras.project(torch.from_numpy(at))[0] - seen.pixels[rows]).norm(dim=-1).numpy()

        def root_of_huber(at):
            error = errors(at)
            return np.sqrt(np.where(error < limit, error**2, 2.0 * limit * error - limit**2))

        best = least_squares(root_of_huber, scene.points[track].numpy(), xtol=1e-9, ftol=1e-9, method="trf").x
        return float((6.0 * np.log1p(errors(best).clip(max=RULES.max_error) ** 2 / (4.0 * NOISE**2))).sum())

    for i in (found.ratio != 0.0).nonzero()[:4, 0].tolist():
        track = int(found.ids[i])
        expected = unlikelihood(track, dry=False) - unlikelihood(track, dry=True)
        assert float(found.ratio[i]) == pytest.approx(expected, rel=0.2, abs=1.0)


def test_tracks_that_decide_nothing_follow_their_neighbours(table):
    scene, truth = table()
    length = torch.bincount(scene.observations.point)
    seen = scene.observations
    first_two = torch.zeros(len(truth), dtype=torch.long)
    keep = torch.ones_like(scene.accepted)
    muted = (torch.arange(len(truth)) % 5 == 0) & (length >= 3)
    for row in muted[seen.point].nonzero()[:, 0].tolist():
        first_two[seen.point[row]] += 1
        keep[row] = first_two[seen.point[row]] <= 2
    scene = replace(scene, observations=seen[keep], accepted=scene.accepted[keep])

    found = find_dry(scene, RULES)

    assert found is not None
    inside = (scene.points[:, 0] - scene.points[truth, 0].min()).abs() > 5.0
    assert (found == truth)[muted & inside].double().mean() > 0.9


class TestStatedExtent:
    """What is stated decides, but for tracks that are clear against it."""

    AT_REST = Similarity(torch.tensor(1.0).double(), torch.eye(3).double(), torch.zeros(3).double())

    def from_above(self, scene, truth, shift=0.0):
        edge = float(scene.points[truth, 0].min()) + shift
        corners = [(-1e4, -1e4), (edge, -1e4), (edge, 1e4), (-1e4, 1e4)]
        return WaterExtent(torch.tensor(corners, dtype=torch.float64))

    def test_sides_are_those_of_the_border_seen_from_above(self, table):
        scene, truth = table()
        sides = stated_sides(scene, self.from_above(scene, truth), self.AT_REST)
        assert ((sides > 0) == truth).double().mean() > 0.98
        assert sides.abs().min() == 1

    def test_photographs_come_before_the_border_from_above(self, table):
        scene, truth = table()
        everything = torch.tensor([(-1e4, -1e4), (1e4, -1e4), (1e4, 1e4), (-1e4, 1e4)], dtype=torch.float64)
        extent = replace(self.from_above(scene, truth), in_images=(everything, *5 * [None]))
        sides = stated_sides(scene, extent, self.AT_REST)
        drawn = torch.zeros_like(truth).index_fill(0, scene.observations.point[scene.observations.view == 0], True)
        assert (sides[drawn] == -1).all()
        assert ((sides > 0) == truth)[~drawn].double().mean() > 0.98

    def test_a_right_statement_is_followed_and_not_disputed(self, table):
        scene, truth = table()
        sides = stated_sides(scene, self.from_above(scene, truth), self.AT_REST)
        found = find_dry(scene, RULES, sides)
        assert found is not None
        assert (found == truth).double().mean() > 0.98
        assert max(disputed(scene, RULES, sides)) <= 4

    def test_a_wrong_one_gives_way_to_clear_tracks_and_is_counted(self, table):
        scene, truth = table()
        wide = stated_sides(scene, self.from_above(scene, truth, shift=1e3), self.AT_REST)
        found = find_dry(scene, RULES, wide)
        assert found is not None
        straight, through_water = disputed(scene, RULES, wide)
        assert straight > 0.3 * int(truth.sum())
        assert through_water == 0
        assert int((found & truth).sum()) >= straight
        assert int((found & ~truth).sum()) == 0


def test_adjusting_again_finds_the_dry_points_or_believes_what_is_known_of_them(table):
    scene, truth = table(points=150)
    everything = replace(scene, accepted=torch.ones_like(scene.accepted), placed=torch.ones_like(scene.placed))

    found, _ = readjust(everything)
    known, _ = readjust(replace(everything, dry=truth))

    assert found.dry is not None
    assert (found.dry == truth).double().mean() > 0.98
    assert torch.equal(known.dry, truth)
    for adjusted in (found, known):
        assert adjusted.errors()[adjusted.accepted].median() < 2.0 * NOISE
        assert adjusted.placed[truth].double().mean() > 0.95


def test_tracks_are_dry_where_most_photographs_with_a_drawn_extent_show_them_outside(survey_of):
    survey, edge = survey_of(cameras=4, points=80), 500.0
    left = torch.tensor([(-9.0, -9.0), (edge, -9.0), (edge, 999.0), (-9.0, 999.0)], dtype=torch.float64)
    capture = replace(survey.capture, water_extent=WaterExtent(None, (left, None, left, left)))

    scene = Scene.of_capture(capture, survey.seen, survey.colors, 1.333)

    seen, votes = scene.observations, [0] * 80
    for view, point, (x, _) in zip(seen.view.tolist(), seen.point.tolist(), seen.pixels.tolist(), strict=True):
        votes[point] += 0 if view == 1 else 1 if x > edge else -1
    assert scene.dry.tolist() == [vote > 0 for vote in votes]
    assert 0 < sum(scene.dry.tolist()) < 80
    assert Scene.of_capture(capture, survey.seen, survey.colors, 1.0).dry is None
    assert Scene.of_capture(survey.capture, survey.seen, survey.colors, 1.333).dry is None
