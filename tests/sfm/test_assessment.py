"""How well a finished scene is determined, as far as anyone can say."""

from dataclasses import replace

import pytest
import torch

from torchrefrac.bundle import BundleOptions
from torchrefrac.geometry import Similarity, heading_rotation
from torchrefrac.optim import LevenbergMarquardtOptions
from torchrefrac.scene import Assessment
from torchrefrac.sfm import adjust
from torchrefrac.sfm.adjust import assess_scene
from torchrefrac.sfm.frame import transformed

OPTIONS = BundleOptions(loss="squared", solver=LevenbergMarquardtOptions(function_tolerance=1e-12))
NOISE = 0.5


@pytest.fixture
def adjusted(survey_of, rules_of):
    """`adjusted(refine, ...)`: survey, adjusted scene, rules and what was fixed, of a survey with half a pixel of
    noise."""

    def make(refine=(), **survey):
        made = survey_of(cameras=6, points=100, noise=NOISE, gravity_error_deg=0.1, **survey)
        rules = rules_of(made, replace(OPTIONS, refine=refine))
        scene, outcome = adjust(made.scene(with_points=True), rules)
        return made, scene, rules, outcome.report.fixed

    return make


def test_noise_and_errors_are_found_as_large_as_they_are(adjusted):
    survey, scene, rules, fixed = adjusted()

    found = assess_scene(scene, rules, fixed)

    assert found.pixel_sigma == pytest.approx(NOISE, rel=0.1)
    assert found.point_sigma is not None
    assert found.point_sigma.shape == (100,)
    assert found.center_sigma is not None
    assert found.center_sigma.shape == (6,)
    ratio = (scene.points - survey.basin.points).square().mean(dim=-1).sqrt().median() / found.point_sigma.median()
    assert 0.4 < float(ratio) < 1.0  # of a coordinate, in the mean of the axes, over the worst axis
    assert found.index_ratio_sigma is None
    assert found.fixed == {}


def test_covariances_of_centres_agree_with_their_deviations_and_turn_with_the_world(adjusted):
    _, scene, rules, fixed = adjusted()
    turn = heading_rotation(torch.tensor(0.7, dtype=torch.float64))
    one, zero = torch.ones((), dtype=torch.float64), torch.zeros(3, dtype=torch.float64)
    turned = transformed(scene, Similarity(one, turn, zero))

    found = assess_scene(scene, rules, fixed).center_covariance
    other = assess_scene(turned, rules, fixed)

    assert found is not None
    assert other.center_covariance is not None
    assert other.center_sigma is not None
    assert torch.allclose(found, found.mT)
    assert (torch.linalg.eigvalsh(found) > 0.0).all()
    assert torch.allclose(other.center_covariance, turn @ found @ turn.mT, rtol=1e-3, atol=1e-6 * float(found.max()))
    assert torch.allclose(other.center_sigma.square(), torch.einsum("mii->m", found) / 3.0, rtol=1e-3)


def test_water_and_scale_are_described_in_sentences(adjusted):
    _, scene, rules, fixed = adjusted()

    found = assess_scene(scene, rules, fixed)

    assert [sentence.split(":")[0] for sentence in found.determined] == [
        "index ratio",
        "tilt of the water to the cameras",
        "height of cameras above the water, relative",
        "scale, relative",
    ]
    assert found.determined[-1] == "scale, relative: not determined"
    assert all("not determined" not in sentence for sentence in found.determined[:-1])


def test_an_index_ratio_that_was_refined_comes_with_its_error(adjusted):
    survey, scene, rules, fixed = adjusted(refine=("index_ratio",))

    found = assess_scene(scene, rules, fixed)

    assert found.index_ratio_sigma is not None
    assert 0.0 < found.index_ratio_sigma < 0.02
    assert abs(scene.index_ratio - survey.basin.index_ratio) < 4.0 * found.index_ratio_sigma


def test_what_was_fixed_has_no_error_and_is_handed_on(adjusted):
    _, scene, rules, _ = adjusted()
    rules = replace(rules, bundle=replace(rules.bundle, refine=("index_ratio", "focal")))

    found = assess_scene(scene, rules, {"index_ratio": "index ratio: not determined"})

    assert found.fixed == {"index_ratio": "index ratio: not determined"}
    assert found.index_ratio_sigma is None
    assert found.determined[0].startswith("focal length, relative: determined to 0.0")


def test_over_land_alone_where_nobody_knows_how_high_the_water_stands_nothing_is_known_but_what_was_fixed(adjusted):
    _, scene, rules, fixed = adjusted(refine=("index_ratio",), land=100)

    found = assess_scene(scene, rules, fixed)

    assert _known(found) == _known(Assessment(fixed={"index_ratio": "index ratio: not determined"}))


def test_in_air_nothing_is_said_of_water(adjusted):
    _, scene, rules, fixed = adjusted(index_ratio=1.0)

    found = assess_scene(scene, rules, fixed)

    assert found.determined == ()
    assert found.point_sigma is not None
    assert found.point_sigma.isfinite().all()


def test_only_registered_views_and_points_that_are_seen_are_assessed(adjusted):
    _, scene, rules, fixed = adjusted()
    seen, registered = scene.observations, torch.arange(6) != 4
    accepted = scene.accepted & (seen.point % 5 != 2) & registered[seen.view]
    scene = replace(scene, views=replace(scene.views, registered=registered), accepted=accepted)

    found = assess_scene(scene, rules, fixed)

    assert found.point_sigma is not None
    assert found.center_sigma is not None
    assert len(found.point_sigma) == len(torch.unique(seen.point[accepted]))
    assert len(found.center_sigma) == 5
    assert found.center_sigma.isfinite().all()


def test_without_observations_nothing_is_known(adjusted):
    _, scene, rules, _ = adjusted()

    found = assess_scene(replace(scene, accepted=torch.zeros_like(scene.accepted)), rules, {})

    assert _known(found) == _known(Assessment())


def test_where_a_view_has_one_observation_nothing_is_known_but_what_was_fixed(adjusted):
    _, scene, rules, _ = adjusted()
    of_third = (scene.observations.view == 3).nonzero()[:, 0]
    accepted = scene.accepted.index_fill(0, of_third[1:], False)

    found = assess_scene(replace(scene, accepted=accepted), rules, {"focal": "focal: not determined"})

    assert _known(found) == _known(Assessment(fixed={"focal": "focal: not determined"}))


def _known(known):
    """What an assessment says, besides which way is up, which it always does."""
    return {name: value for name, value in vars(known).items() if name != "up"}
