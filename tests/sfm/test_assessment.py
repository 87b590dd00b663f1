"""What is said about how well a finished model is determined."""

from dataclasses import replace

import pytest
import torch

from torchrefrac.bundle import BundleOptions
from torchrefrac.geometry import heading_rotation
from torchrefrac.optim import LevenbergMarquardtOptions
from torchrefrac.scene import Assessment
from torchrefrac.sfm.adjustment import adjust_model, assess_model

OPTIONS = BundleOptions(loss="squared", solver=LevenbergMarquardtOptions(function_tolerance=1e-12))
NOISE = 0.5


@pytest.fixture
def adjusted(survey_of):
    """`adjusted(refine, ...)`: survey, adjusted model and options, of a survey with half a pixel of noise."""

    def make(refine=(), **survey):
        made = survey_of(cameras=6, points=100, noise=NOISE, gravity_error_deg=0.1, **survey)
        options = replace(OPTIONS, refine=refine)
        model, report = adjust_model(made.model(with_points=True), made.capture, options)
        return made, model, options, report

    return make


def test_noise_and_errors_are_told_as_large_as_they_are(adjusted):
    survey, model, options, report = adjusted()

    told = assess_model(model, survey.capture, options, report.held)

    assert told.pixel_sigma == pytest.approx(NOISE, rel=0.1)
    assert told.point_sigma is not None
    assert told.point_sigma.shape == (100,)
    assert told.center_sigma is not None
    assert told.center_sigma.shape == (6,)
    ratio = (model.points - survey.basin.points).square().mean(dim=-1).sqrt().median() / told.point_sigma.median()
    assert 0.5 < float(ratio) < 2.0
    assert told.index_ratio_sigma is None
    assert told.held == {}


def test_covariances_of_centres_agree_with_their_deviations_and_turn_with_the_world(adjusted):
    survey, model, options, report = adjusted()
    turn = heading_rotation(torch.tensor(0.7, dtype=torch.float64))
    turned = replace(
        model, rotation=model.rotation @ turn.mT, center=model.center @ turn.mT, points=model.points @ turn.mT
    )

    told = assess_model(model, survey.capture, options, report.held).center_covariance
    other = assess_model(turned, survey.capture, options, report.held)

    assert told is not None
    assert other.center_covariance is not None
    assert other.center_sigma is not None
    assert torch.allclose(told, told.mT)
    assert (torch.linalg.eigvalsh(told) > 0.0).all()
    assert torch.allclose(other.center_covariance, turn @ told @ turn.mT, rtol=1e-3, atol=1e-6 * float(told.max()))
    assert torch.allclose(other.center_sigma.square(), torch.einsum("mii->m", told) / 3.0, rtol=1e-3)


def test_water_and_scale_are_told_in_sentences(adjusted):
    survey, model, options, report = adjusted()

    told = assess_model(model, survey.capture, options, report.held)

    assert [sentence.split(":")[0] for sentence in told.determined] == [
        "index ratio",
        "tilt of the water to the cameras",
        "height of cameras above the water, relative",
        "scale, relative",
    ]
    assert told.determined[-1] == "scale, relative: not determined"
    assert all("not determined" not in sentence for sentence in told.determined[:-1])


def test_an_index_ratio_that_was_refined_is_told_with_its_error(adjusted):
    survey, model, options, report = adjusted(refine=("index_ratio",))

    told = assess_model(model, survey.capture, options, report.held)

    assert told.index_ratio_sigma is not None
    assert 0.0 < told.index_ratio_sigma < 0.02
    assert abs(float(model.index_ratio) - survey.basin.index_ratio) < 4.0 * told.index_ratio_sigma


def test_what_was_held_has_no_error_and_is_handed_on(adjusted):
    survey, model, options, _ = adjusted()
    options = replace(options, refine=("index_ratio", "focal"))

    told = assess_model(model, survey.capture, options, {"index_ratio": "index ratio: not determined"})

    assert told.held == {"index_ratio": "index ratio: not determined"}
    assert told.index_ratio_sigma is None
    assert told.determined[0].startswith("focal length, relative: determined to 0.0")


def test_over_land_alone_where_nobody_knows_how_high_the_water_stands_nothing_is_told_but_what_was_held(adjusted):
    survey, model, options, report = adjusted(refine=("index_ratio",), land=100)

    told = assess_model(model, survey.capture, options, report.held)

    assert told == Assessment(held={"index_ratio": "index ratio: not determined"})


def test_in_air_nothing_is_said_of_water(adjusted):
    survey, model, options, report = adjusted(index_ratio=1.0)

    told = assess_model(model, survey.capture, options, report.held)

    assert told.determined == ()
    assert told.point_sigma is not None
    assert told.point_sigma.isfinite().all()


def test_only_registered_images_and_points_that_are_seen_are_told_of(adjusted):
    survey, model, options, report = adjusted()
    idle = model.tracks.track % 5 == 2
    registered = torch.arange(6) != 4
    model = replace(model, registered=registered, active=model.active & ~idle & registered[model.tracks.image])

    told = assess_model(model, survey.capture, options, report.held)

    assert told.point_sigma is not None
    assert told.center_sigma is not None
    assert len(told.point_sigma) == len(torch.unique(model.tracks.track[model.active]))
    assert len(told.center_sigma) == 5
    assert told.center_sigma.isfinite().all()


def test_without_observations_nothing_is_known(adjusted):
    survey, model, options, _ = adjusted()

    told = assess_model(replace(model, active=torch.zeros_like(model.active)), survey.capture, options, {})

    assert told == Assessment()


def test_where_an_image_has_one_observation_nothing_is_told_but_what_was_held(adjusted):
    survey, model, options, _ = adjusted()
    of_third = (model.tracks.image == 3).nonzero()[:, 0]
    active = model.active.clone()
    active[of_third[1:]] = False

    told = assess_model(replace(model, active=active), survey.capture, options, {"focal": "focal: not determined"})

    assert told == Assessment(held={"focal": "focal: not determined"})
