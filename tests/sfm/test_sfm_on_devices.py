"""Pairs, reconstructions and adjustments that are worked on elsewhere: the same results, on the CPU."""

from dataclasses import replace

import pytest
import torch

from tests.made_device import on_every_device
from tests.planted_reconstructions import plant_reconstruction
from tests.sfm.test_reconstruct_sparse import HARD, OPTIONS, reconstruct
from torchrefrac.bundle import BundleOptions
from torchrefrac.numerics import AUTO, on_device
from torchrefrac.recorder import SilentRecorder
from torchrefrac.sfm import (
    ReadjustOptions,
    RefractiveInitializer,
    Rules,
    SfmOptions,
    adjust,
    readjust,
    triangulate,
    verify_pairs,
)
from torchrefrac.sfm.adjust import adjust_locally, assess_scene
from torchrefrac.sfm.pose import Resection, draws_of
from torchrefrac.sfm.rules import WORTH_A_GPU


@on_every_device
def test_matches_that_agree_on_a_pose_are_those_of_the_cpu(survey_of, device):
    survey = survey_of(cameras=3, points=100, **HARD)

    here, there = (_verified(survey, SfmOptions(device=on)) for on in ("cpu", device))

    for one, other in zip(there, here, strict=True):
        assert one.pose.center.device.type == "cpu"
        torch.testing.assert_close(one.pose.center, other.pose.center, rtol=1e-4, atol=1e-4)
        assert abs(len(one.pair) - len(other.pair)) <= (0 if device == "made" else 2)


@on_every_device
def test_poses_of_images_are_those_of_the_cpu(survey_of, device):
    survey = survey_of(cameras=3, points=100, **HARD)
    seen = [survey.common(image) for image in range(3)]
    images = [
        Resection(image, survey.basin.lens, pixels, survey.basin.points[track])
        for image, (pixels, _, track) in enumerate(seen)
    ]

    here, there = (
        RefractiveInitializer(survey.capture, survey.basin.index_ratio, SfmOptions(device=on)).absolute_each(
            images, [draws_of(1, image) for image in range(3)]
        )
        for on in ("cpu", device)
    )

    for one, other in zip(there, here, strict=True):
        assert one.center.device.type == one.inliers.device.type == "cpu"
        torch.testing.assert_close(one.center, other.center, rtol=1e-4, atol=1e-4)
        assert (one.inliers != other.inliers).sum() <= (0 if device == "made" else 2)


@on_every_device
@pytest.mark.parametrize("local", [False, True], ids=["everything", "some views"])
def test_what_is_adjusted_and_how_well_it_is_known_are_as_on_the_cpu(survey_of, rules_of, local, device):
    survey = survey_of(points=40, noise=0.1, gravity_error_deg=0.5)
    scene, some = survey.scene(with_points=True), torch.arange(4) >= 2

    scenes, assessments = [], []
    for on in ("cpu", device):
        rules = replace(rules_of(survey, BundleOptions()), device=on)
        adjusted, outcome = adjust_locally(scene, rules, some) if local else adjust(scene, rules)
        assert outcome.report.scene.points.device.type == on
        scenes.append(adjusted)
        assessments.append(assess_scene(adjusted, rules, {}))

    here, there = scenes
    torch.testing.assert_close(there.points, here.points, rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(there.views.center, here.views.center, rtol=1e-9, atol=1e-9)
    known, expected = reversed(assessments)
    torch.testing.assert_close(known.point_covariance, expected.point_covariance, rtol=1e-6, atol=1e-9)
    assert known.determined == expected.determined


@on_every_device
def test_points_are_placed_where_they_are_on_the_cpu(survey_of, device):
    scene = survey_of(points=40, noise=0.1, outliers=0.05).scene()

    here, there = (triangulate(on_device(scene, on), Rules())[0] for on in ("cpu", device))

    assert there.points.device.type == device
    assert torch.equal(there.placed.cpu(), here.placed)
    assert torch.equal(there.accepted.cpu(), here.accepted)
    torch.testing.assert_close(there.points.cpu(), here.points, rtol=1e-9, atol=1e-9)


@pytest.mark.slow
@on_every_device
def test_a_reconstruction_is_that_of_the_cpu(survey_of, device):
    survey = survey_of(cameras=4, points=80, **HARD)

    here, there = (reconstruct(survey, replace(OPTIONS, device=on)) for on in ("cpu", device))

    assert there.points.device.type == "cpu"
    assert len(there.points) == len(here.points)
    torch.testing.assert_close(there.points, here.points, rtol=1e-6, atol=1e-6)
    torch.testing.assert_close(there.views.center, here.views.center, rtol=1e-6, atol=1e-6)
    torch.testing.assert_close(there.assessment.point_covariance, here.assessment.point_covariance)
    assert there.assessment.determined == here.assessment.determined


@pytest.mark.slow
@on_every_device
def test_a_scene_is_adjusted_again_to_what_it_is_on_the_cpu(make_basin, draw, device):
    given = plant_reconstruction(make_basin(cameras=4, points=40, seen_by=3), draw, noise=0.1).as_of_a_pinhole(draw)

    here, there = (readjust(given, None, ReadjustOptions(rounds=1, device=on))[0] for on in ("cpu", device))

    torch.testing.assert_close(there.points, here.points, rtol=1e-6, atol=1e-6)
    torch.testing.assert_close(there.assessment.center_sigma, here.assessment.center_sigma)


def test_small_adjustments_are_left_to_the_cpu_unless_a_device_is_named(survey_of, monkeypatch):
    part = survey_of().scene(with_points=True).part()
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)

    assert len(part.scene.observations) < WORTH_A_GPU
    assert Rules(device=AUTO).to_adjust(part)[0] is part.scene
    assert Rules(device="made").to_adjust(part)[0].points.device.type == "made"


def _verified(survey, options):
    initializer = RefractiveInitializer(survey.capture, survey.basin.index_ratio, options)
    generator = torch.Generator().manual_seed(1)
    return verify_pairs(survey.pairs(), survey.features(), initializer, 20, generator, SilentRecorder())
