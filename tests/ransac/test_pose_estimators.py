"""The pose estimators: what a match costs, and poses among outliers."""

from dataclasses import replace

import pytest
import torch

from torchrefrac.camera import RefractiveCamera
from torchrefrac.geometry import heading_rotation, level_rotation
from torchrefrac.ransac import AbsolutePoseEstimator, RansacOptions, RelativePoseEstimator, ransac
from torchrefrac.refraction import FlatInterface

WATER = torch.tensor(1.33, dtype=torch.float64)
HEIGHT = 30.0
OPTIONS = RansacOptions()
relative_and_absolute = pytest.mark.parametrize("kind", ["relative", "absolute"])


@pytest.fixture
def make_problem(make_basin, draw):
    """`make_problem(kind, noise=0.0, outliers=0)`: an estimator of 200 matches, its true model (heading, centre), which
    matches are true, and the basin. `noise` is in pixels; outliers have a random pixel in the last image."""

    def make(kind, noise=0.0, outliers=0):
        basin = make_basin(cameras=2 if kind == "relative" else 1, points=200)
        pixels, _ = basin.project()
        pixels = pixels + noise * draw.normal(*pixels.shape)
        pixels[-1, :outliers] = draw.uniform(0.0, 1.0, outliers, 2) * pixels.new_tensor((1024.0, 768.0))
        heading, center = basin.second_from_first() if kind == "relative" else (basin.heading[0], basin.center[0])
        estimator = make_estimator(basin, pixels)
        return estimator, torch.cat((heading[None], center)), torch.arange(200) >= outliers, basin

    return make


def make_estimator(basin, pixels):
    plane, cam_from_level = basin.lens.plane_from_pixels(pixels), level_rotation(basin.down_in_cam)
    if len(plane) == 1:
        return AbsolutePoseEstimator(plane[0], basin.points, cam_from_level[0], basin.lens.focal, WATER)
    return RelativePoseEstimator(*plane, *cam_from_level, basin.lens.focal, WATER, HEIGHT)


def camera_at(model, basin, image):
    """The camera (H) that models (H, 4) of image `image` mean."""
    rotation = level_rotation(basin.down_in_cam[image]) @ heading_rotation(model[:, 0])
    return RefractiveCamera(basin.lens, rotation, model[:, 1:], FlatInterface(1.33))


@relative_and_absolute
def test_at_the_true_model_clean_matches_cost_nothing(make_problem, kind):
    estimator, truth, _, _ = make_problem(kind)

    assert estimator.squared_errors(truth[None]).amax() < 1e-16


def test_a_known_point_costs_its_squared_reprojection_error_or_infinity_behind_the_camera(make_problem, draw):
    estimator, truth, _, basin = make_problem("absolute", noise=0.3)
    models = truth + draw.normal(50, 4) * truth.new_tensor((2.0, 200.0, 200.0, 5.0))

    errors = estimator.squared_errors(models)

    pixels, valid = camera_at(models, basin, 0)[:, None].project(basin.points)
    noisy = estimator._plane * basin.lens.focal + basin.lens.principal_point
    expected = torch.where(valid, (pixels - noisy).square().sum(dim=-1), torch.inf)
    assert 0 < valid.sum() < valid.numel()
    torch.testing.assert_close(errors, expected, rtol=1e-7, atol=1e-9)


def test_a_match_costs_the_mean_over_both_images_of_the_error_of_its_triangulated_point(make_basin, draw):
    basin = make_basin(points=200)
    noisy = basin.project()[0] + 3.0 * draw.normal(2, 200, 2)
    estimator = make_estimator(basin, noisy)
    truth = torch.cat((basin.second_from_first()[0][None], basin.second_from_first()[1]))
    models = truth + draw.normal(20, 4) * truth.new_tensor((0.01, 0.3, 0.3, 0.3))

    errors = estimator.squared_errors(models)

    points, below = estimator.triangulate(models)
    first = camera_at(torch.tensor([[0.0, 0.0, 0.0, HEIGHT]], dtype=torch.float64), basin, 0)
    second = camera_at(models, basin, 1)
    squares = [(c[:, None].project(points)[0] - p).square().sum(-1) for c, p in ((first, noisy[0]), (second, noisy[1]))]
    assert below.all()
    torch.testing.assert_close(errors, 0.5 * (squares[0] + squares[1]), rtol=1e-9, atol=1e-9)


def test_matches_of_a_clean_pair_triangulate_to_the_points(make_problem):
    estimator, truth, _, basin = make_problem("relative")

    points, below = estimator.triangulate(truth[None])

    assert below.all()
    in_first = basin.points - basin.center[0] * basin.center.new_tensor((1.0, 1.0, 0.0))
    in_first = in_first @ heading_rotation(basin.heading[0]).mT
    torch.testing.assert_close(points[0], in_first, rtol=0.0, atol=1e-8)


def test_a_match_whose_rays_meet_above_the_water_is_impossible(make_basin):
    basin = make_basin(points=40, land=20)
    pixels, _ = basin.project()
    heading, center = basin.second_from_first()

    errors = make_estimator(basin, pixels).squared_errors(torch.cat((heading[None], center))[None])[0]

    assert (errors[:20] == torch.inf).all()
    assert (errors[20:] < 1e-16).all()


def test_a_match_behind_a_camera_is_impossible(make_problem, draw):
    estimator, truth, _, basin = make_problem("relative")
    models = truth + draw.normal(200, 4) * truth.new_tensor((2.0, 300.0, 300.0, 5.0))

    errors = estimator.squared_errors(models)

    points, below = estimator.triangulate(models)
    ahead = camera_at(models, basin, 1)[:, None].project(points)[1]
    assert (below & ~ahead).any()
    assert (errors[~ahead] == torch.inf).all()


@relative_and_absolute
def test_minimal_samples_of_clean_matches_give_the_true_model(make_problem, kind, generator):
    estimator, truth, _, _ = make_problem(kind)
    samples = torch.stack([torch.randperm(200, generator=generator)[: estimator.sample_size] for _ in range(20)])

    models, valid = estimator.solve(samples)

    assert (models.shape, valid.shape) == ((20, 2, 4), (20, 2))
    error = torch.where(valid, _distance(models, truth), torch.inf).amin(dim=-1)
    assert error.amax() < 1e-6


@relative_and_absolute
def test_a_refit_to_many_noisy_matches_comes_near_the_truth(make_problem, kind):
    estimator, truth, _, _ = make_problem(kind, noise=0.3)

    models, valid = estimator.refit(truth, torch.ones(200, dtype=torch.bool))

    assert valid[0]
    assert _distance(models[0], truth) < 0.05


@pytest.mark.parametrize(("kind", "tolerance"), [("relative", 0.15), ("absolute", 0.002)])
def test_the_pose_is_found_among_40_percent_outliers(make_problem, generator, kind, tolerance):
    estimator, truth, is_inlier, _ = make_problem(kind, noise=0.3, outliers=80)

    report = ransac(estimator, OPTIONS, generator)

    assert report.status == "success"
    assert _distance(report.model, truth) < tolerance
    assert (report.inliers & is_inlier).sum() >= 0.95 * is_inlier.sum()
    assert (report.inliers & ~is_inlier).sum() < 0.02 * report.num_inliers


@relative_and_absolute
def test_the_same_seed_finds_the_same_pose_to_the_last_bit(make_problem, kind):
    estimator, _, _, _ = make_problem(kind, noise=0.3, outliers=80)

    one, two = (ransac(estimator, OPTIONS, torch.Generator().manual_seed(7)) for _ in range(2))

    assert torch.equal(one.model, two.model)
    assert torch.equal(one.inliers, two.inliers)


@relative_and_absolute
def test_random_matches_have_no_consensus(make_problem, generator, kind):
    estimator, _, _, _ = make_problem(kind, outliers=200)

    report = ransac(estimator, replace(OPTIONS, max_samples=500, min_inliers=30), generator)

    assert report.status == "no_consensus"


def _distance(model, truth):
    """The larger of the error of the heading (radians) and that of the centre (part of its distance to the origin)."""
    heading = torch.atan2((model - truth)[..., 0].sin(), (model - truth)[..., 0].cos()).abs()
    return torch.maximum(heading, (model - truth)[..., 1:].norm(dim=-1) / truth[1:].norm())
