"""The pose estimators: what a match costs, poses among outliers, and what cannot be determined."""

import math
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from torchrefrac.camera import RefractiveCamera
from torchrefrac.ransac import AbsolutePoseEstimator, RansacOptions, RelativePoseEstimator, ransac
from torchrefrac.refinement import OneView, TwoViews
from torchrefrac.refraction import FlatInterface

OPTIONS = RansacOptions(max_error=2.0)
relative_and_absolute = pytest.mark.parametrize("kind", ["relative", "absolute"])


@relative_and_absolute
def test_at_the_true_model_clean_matches_cost_nothing(make_problem, kind):
    estimator, truth, _, _ = make_problem(kind, gravity_error_deg=1.0)

    assert estimator.squared_errors(truth[None], None).amax() < 1e-12


@relative_and_absolute
def test_errors_in_single_precision_are_those_in_double_to_a_hundredth_of_a_pixel(make_problem, draw, kind):
    estimator, truth, _, _ = make_problem(kind, noise=1.0)
    models = truth + 1e-3 * draw.normal(20, len(truth))

    exact = estimator.squared_errors(models, None)

    assert estimator.squared_errors(models.float(), None).dtype == torch.float32
    near = exact < 100.0
    single = estimator.squared_errors(models.float(), None).double()
    torch.testing.assert_close(single[near].sqrt(), exact[near].sqrt(), rtol=0.0, atol=0.01)


@relative_and_absolute
def test_some_rows_cost_what_they_cost_among_all(make_problem, draw, kind):
    estimator, truth, _, _ = make_problem(kind, noise=1.0)
    models, rows = truth + 1e-3 * draw.normal(3, len(truth)), torch.tensor([5, 7, 150])

    some = estimator.squared_errors(models, rows)

    torch.testing.assert_close(some, estimator.squared_errors(models, None)[:, rows], rtol=1e-9, atol=1e-12)


def test_a_known_point_costs_its_squared_reprojection_error_or_infinity_behind_the_camera(make_problem, draw):
    estimator, truth, _, basin = make_problem("absolute", noise=0.3, land=20)
    models = truth + draw.normal(50, 6) * truth.new_tensor((0.0, 0.0, 2.0, 200.0, 200.0, 5.0))

    errors = estimator.squared_errors(models, None)

    rotation, center = estimator.data.poses(models)
    camera = RefractiveCamera(basin.lens, rotation, center, FlatInterface(1.33))[:, None]
    pixels, valid = camera.project(basin.points)
    noisy = estimator.data.plane * basin.lens.focal + basin.lens.principal_point
    expected = torch.where(valid, (pixels - noisy).square().sum(dim=-1), torch.inf)
    assert 0 < valid.sum() < valid.numel()
    torch.testing.assert_close(errors, expected, rtol=1e-6, atol=1e-8)


def test_a_match_whose_rays_meet_above_the_water_is_impossible(make_problem):
    estimator, truth, _, _ = make_problem("relative", points=40, land=20)

    errors = estimator.squared_errors(truth[None], None)[0]

    assert (errors[:20] == torch.inf).all()
    assert (errors[20:] < 1e-12).all()


@pytest.mark.parametrize("known_heading", [False, True], ids=["heading free", "heading known"])
@relative_and_absolute
def test_minimal_samples_of_clean_matches_give_the_true_model(make_problem, kind, generator, known_heading):
    estimator, truth, _, _ = make_problem(kind, known_heading=known_heading)
    samples = torch.stack([torch.randperm(200, generator=generator)[: estimator.sample_size] for _ in range(20)])

    models, valid = estimator.solve(samples)

    assert estimator.sample_size == {"relative": 3 if known_heading else 4, "absolute": 2}[kind]
    error = torch.where(valid, _distance(models, truth), torch.inf).amin(dim=-1)
    assert (error < 1e-6).double().mean() >= 0.95


@pytest.mark.parametrize(("gravity_error_deg", "limit"), [(0.5, 0.02), (2.0, 0.02)])
def test_the_relative_pose_is_found_among_half_outliers_and_with_gravity_off(
    make_problem, generator, gravity_error_deg, limit
):
    estimator, truth, right, basin = make_problem(
        "relative", points=600, noise=0.5, outliers=300, gravity_error_deg=gravity_error_deg
    )

    report = ransac(estimator, OPTIONS, generator)

    assert report.status == "success"
    baseline = (basin.center[1] - basin.center[0]).norm()
    assert (report.model[5:] - truth[5:]).norm() < limit * baseline
    assert _turn_deg(report.model[4] - truth[4]) < 0.2
    assert (report.inliers & right).sum() >= 0.99 * right.sum()
    assert (report.inliers & ~right).sum() <= 0.02 * (~right).sum()


@pytest.mark.parametrize("land", [0, 50], ids=["water", "water and land"])
def test_the_absolute_pose_is_found_among_four_fifths_outliers_and_with_gravity_off(make_problem, generator, land):
    estimator, truth, right, basin = make_problem(
        "absolute", points=500, noise=0.5, outliers=400, gravity_error_deg=2.0, land=land
    )

    report = ransac(estimator, OPTIONS, generator)

    assert report.status == "success"
    assert (report.model[3:] - truth[3:]).norm() < 0.01 * basin.center[0, 2]
    assert torch.rad2deg((report.model[:2] - truth[:2]).norm()) < 0.2
    assert _turn_deg(report.model[2] - truth[2]) < 0.2
    assert (report.inliers & right).sum() >= 0.98 * right.sum()


@relative_and_absolute
def test_a_known_heading_stays_as_it_is(make_problem, generator, kind):
    estimator, truth, _, _ = make_problem(kind, noise=0.5, outliers=60, gravity_error_deg=1.0, known_heading=True)

    report = ransac(estimator, OPTIONS, generator)

    assert report.status == "success"
    index = len(truth) - 4
    assert torch.equal(report.model[index], truth[index])
    assert _distance(report.model, truth) < 0.02


@relative_and_absolute
def test_the_same_seed_finds_the_same_pose_to_the_last_bit(make_problem, kind):
    estimator, _, _, _ = make_problem(kind, noise=0.3, outliers=80, gravity_error_deg=0.5)

    one, two = (ransac(estimator, OPTIONS, torch.Generator().manual_seed(7)) for _ in range(2))

    assert torch.equal(one.model, two.model)
    assert torch.equal(one.inliers, two.inliers)


@relative_and_absolute
def test_a_refinement_that_walks_off_its_consensus_is_not_taken(make_problem, draw, kind, monkeypatch):
    estimator, truth, _, _ = make_problem(kind, noise=0.3)
    near, far = truth[None] + 1e-5 * draw.normal(1, len(truth)), truth[None] + 10.0
    monkeypatch.setattr(type(estimator.data), "refine", lambda *_: SimpleNamespace(states=far))

    for thorough in (False, True):
        models, costs = estimator.optimize(near, OPTIONS.max_error, None, thorough)

        assert torch.equal(models, near)
        assert torch.equal(costs, estimator.data.costs(near, OPTIONS.max_error))


@relative_and_absolute
@pytest.mark.parametrize("land", [0, 120])
def test_no_fewer_agree_in_the_end_than_with_the_best_minimal_sample(make_problem, generator, kind, land):
    """Nor where some points are dry."""
    estimator, _, _, _ = make_problem(kind, points=1500, noise=0.5, gravity_error_deg=0.5, land=land)
    solve, agree = estimator.solve, [0]

    def counted(samples):
        models, valid = solve(samples)
        errors = estimator.squared_errors(models[valid], None)
        agree.append(int((errors < OPTIONS.max_error**2).sum(dim=-1).max()))
        return models, valid

    estimator.solve = counted

    report = ransac(estimator, OPTIONS, generator)

    assert report.num_inliers >= max(agree) > 1000


@relative_and_absolute
def test_random_matches_have_no_consensus_and_give_no_pose(make_problem, generator, kind):
    estimator, _, _, _ = make_problem(kind, outliers=200)

    report = ransac(estimator, replace(OPTIONS, max_samples=500, min_inliers=30), generator)

    assert (report.status, len(report.model)) == ("no_consensus", 0)


@relative_and_absolute
def test_identical_matches_give_no_pose(make_problem, generator, kind):
    estimator, _, _, _ = make_problem(kind)
    alike = torch.zeros(50, dtype=torch.long)
    if kind == "relative":
        same = RelativePoseEstimator(estimator.data.rows(alike))
    else:
        same = AbsolutePoseEstimator(estimator.data.rows(alike))

    report = ransac(same, replace(OPTIONS, max_samples=400), generator)

    assert report.status != "success"
    assert len(report.model) == 0


@pytest.mark.parametrize("noise", [0.0, 0.3])
def test_points_in_the_vertical_plane_through_both_cameras_determine_no_pose(make_degenerate, generator, noise):
    """The first degenerate case of Chang & Chen (section 3.4.1)."""
    report = ransac(make_degenerate("along", noise), OPTIONS, generator)

    assert report.status != "success"
    assert len(report.model) == 0


@pytest.mark.parametrize("noise", [0.0, 0.3])
def test_equally_high_cameras_and_points_in_the_bisecting_plane_determine_no_pose(make_degenerate, generator, noise):
    """The second degenerate case of Chang & Chen (section 3.4.1)."""
    report = ransac(make_degenerate("across", noise), OPTIONS, generator)

    assert report.status != "success"
    assert len(report.model) == 0


@pytest.mark.parametrize(("where", "words"), [("along", "vertical plane"), ("across", "bisects")])
def test_the_reason_names_the_degenerate_case(make_degenerate, where, words):
    estimator = make_degenerate(where, 0.0)

    reason = estimator.degeneracy(estimator.truth, torch.ones(100, dtype=torch.bool))

    assert words in reason


def test_under_a_millimetre_of_water_the_pose_is_found_because_the_surface_is_where_the_points_are(
    make_degenerate, generator
):
    estimator = make_degenerate("thin", 0.3)

    report = ransac(estimator, OPTIONS, generator)

    assert report.status == "success"
    assert (report.model[5:] - estimator.truth[5:]).norm() < 0.01 * estimator.truth[5:7].norm()
    assert report.num_inliers > 90  # of 100: noise lifts some above the water


@pytest.mark.parametrize("index_ratio", [1.0005, 1.002])
def test_where_the_water_hardly_bends_light_the_pose_is_not_determined_and_the_reason_says_so(
    make_problem, index_ratio
):
    estimator, truth, _, _ = make_problem("relative", noise=0.5, index_ratio=index_ratio, gravity_error_deg=0.5)

    reason = estimator.degeneracy(truth, torch.ones(200, dtype=torch.bool))

    assert f"at an index ratio of {index_ratio:g} the water bends these rays too little" in reason
    assert "% of the baseline" in reason


def test_points_all_but_in_one_place_do_not_determine_an_absolute_pose(make_problem, draw):
    estimator, truth, _, _ = make_problem("absolute")
    view = estimator.data
    near = replace(view, points=view.points[:1] + 1e-3 * draw.normal(200, 3))

    assert "too close together" in AbsolutePoseEstimator(near).degeneracy(truth, torch.ones(200, dtype=torch.bool))


@relative_and_absolute
def test_an_ordinary_scene_is_not_called_degenerate(make_problem, kind):
    estimator, truth, right, _ = make_problem(kind, noise=0.5, gravity_error_deg=2.0)

    assert estimator.degeneracy(truth, right) == ""


@pytest.mark.parametrize(
    ("plane1", "plane2", "message"),
    [
        (torch.ones(5, 3), torch.ones(5, 3), r"image coordinates have shape \(5, 3\), but must be \(N, 2\)"),
        (torch.ones(5, 2), torch.ones(4, 2), "plane2 has 4 rows, but there are 5 image coordinates"),
        (torch.full((5, 2), torch.nan), torch.ones(5, 2), "image coordinates is nan somewhere"),
        (torch.ones(5, 2), torch.full((5, 2), torch.inf), "plane2 is inf somewhere"),
    ],
    ids=["three coordinates", "other count", "nan", "infinite"],
)
def test_matches_that_cannot_be_are_refused(plane1, plane2, message):
    with pytest.raises(ValueError, match=message):
        RelativePoseEstimator(TwoViews(plane1, plane2, torch.eye(3).expand(2, 3, 3), torch.ones(2), torch.tensor(1.33)))


def test_a_relative_pose_without_refraction_is_refused():
    views = TwoViews(torch.ones(5, 2), torch.ones(5, 2), torch.eye(3).expand(2, 3, 3), torch.ones(2), torch.tensor(1.0))

    with pytest.raises(ValueError, match=r"index_ratio \(without refraction .*\) is 1, but must be finite and above 1"):
        RelativePoseEstimator(views)


@pytest.mark.parametrize(
    ("points", "message"),
    [(torch.ones(4, 3), "points has 4 rows"), (torch.full((5, 3), torch.nan), "points is nan somewhere")],
)
def test_points_that_cannot_be_are_refused(points, message):
    with pytest.raises(ValueError, match=message):
        AbsolutePoseEstimator(OneView(torch.ones(5, 2), points, torch.eye(3), torch.ones(2), torch.tensor(1.33)))


def _turn_deg(angle):
    return abs(math.degrees(math.remainder(float(angle), 2.0 * math.pi)))


def _distance(model, truth):
    """The larger of the error of the heading (radians) and that of the centre (part of its distance to the origin)."""
    difference = model - truth
    heading = torch.atan2(difference[..., -4].sin(), difference[..., -4].cos()).abs()
    return torch.maximum(heading, difference[..., -3:].norm(dim=-1) / truth[-3:].norm())
