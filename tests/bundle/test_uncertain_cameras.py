"""Cameras that state how uncertain they are: what is refined of which, and how it stays near what is stated."""

from dataclasses import replace

import pytest
import torch

from tests.bundle.changes import changed
from torchrefrac.bundle import BundleOptions, adjust, adjust_differentiably, adjust_pose, determinations, uncertainty
from torchrefrac.bundle.layout import Layout
from torchrefrac.bundle.observability import coefficients_as_stated
from torchrefrac.bundle.score import wished_changes
from torchrefrac.bundle.terms import Expectations, GlobalPrior, expectations


def stating(scene, **sigmas):
    """The scene, whose cameras state these sigmas."""
    values = {f"{name}_sigma": torch.tensor(sigma, dtype=torch.float64) for name, sigma in sigmas.items()}
    return replace(scene, cameras=replace(scene.cameras, **values))


def test_what_a_camera_states_to_be_uncertain_varies_and_nothing_else(plant):
    scene = stating(plant(cameras=2).truth, focal=[0.01, 0.0], distortion=[0.0, 0.1])

    layout = Layout.create(scene)

    assert layout.intrinsics == ("focal", "distortion")
    assert layout.fixed_intrinsics["focal"].tolist() == [[False], [True]]
    assert layout.fixed_intrinsics["distortion"].tolist() == [[True] * 5, [False] * 5]
    columns = layout.intrinsics_columns("focal", torch.tensor([0, 1]))
    assert columns[0, 0] < layout.size
    assert columns[1, 0] == layout.size
    assert Layout.create(scene.detached(), ("focal", "distortion")).fixed_intrinsics == {}
    assert Layout.create(replace(scene, cameras=scene.cameras.exact())).intrinsics == ()


def test_radial_terms_vary_beside_the_distortion_that_another_camera_states(plant):
    scene = stating(plant(cameras=2).truth, distortion=[0.0, 0.1])

    layout = Layout.create(scene, ("radial",))

    assert layout.intrinsics == ("distortion",)
    assert layout.fixed_intrinsics["distortion"].tolist() == [[False, False, True, True, True], [False] * 5]


def test_a_fisheye_has_four_coefficients(plant):
    truth = plant(cameras=2).truth
    scene = replace(truth, cameras=replace(truth.cameras, models=("opencv", "fisheye")))

    fixed = Layout.create(scene, ("distortion",)).fixed_intrinsics["distortion"]
    assert fixed.tolist() == [[False] * 5, [False] * 4 + [True]]


def test_the_rows_of_what_is_held_are_zero_and_the_others_as_ever(plant):
    planted = plant(cameras=2, noise=0.5)
    free = planted.problem(refine=("focal", "principal_point"))
    held = Layout.create(stating(planted.truth, focal=[0.01, 0.0], principal_point=[0.0, 2.0]))
    some = free.with_layout(planted.truth, held, free.options, ())

    whole, part = free.linearize(planted.truth).system, some.linearize(planted.truth).system

    first = 6 * len(planted.truth.views)
    assert part.dead[first:].tolist() == [False, True, True, True, False, False]
    assert not whole.dead.any()


def test_an_uncertain_focal_length_is_found_and_that_of_the_other_camera_stays(plant, disturb):
    planted = plant(views=6, points=60, cameras=2)
    truth = planted.truth
    wrong = truth.cameras.focal * torch.tensor([[1.03], [1.0]], dtype=torch.float64)
    start = stating(changed(disturb(truth, 0.3), focal=wrong), focal=[0.05, 0.0])

    report = planted.adjusted(start, terms=[planted.gravity], pixel_sigma=0.01)

    found = report.scene.cameras
    torch.testing.assert_close(found.focal[0], truth.cameras.focal[0], rtol=1e-4, atol=0.0)
    assert torch.equal(found.focal[1], truth.cameras.focal[1])
    assert found.stated is not None
    assert torch.equal(found.stated.focal, wrong)


def test_a_camera_stays_within_what_it_states_however_often_it_is_adjusted(plant, squared):
    planted = plant(views=5, points=40, noise=0.5)
    start = stating(changed(planted.truth, focal=planted.truth.cameras.focal * 1.02), focal=[1e-3])
    options = replace(squared, pixel_sigma=0.5)

    once = adjust(planted.seen_in(start), options, terms=[planted.gravity]).scene
    again = adjust(once, options, terms=[planted.gravity]).scene

    assert float(once.cameras.focal[0, 0] / start.cameras.focal[0, 0]) < 0.9999
    torch.testing.assert_close(again.cameras.focal, once.cameras.focal, rtol=1e-7, atol=0.0)


def test_a_stated_sigma_comes_before_the_expected_one(plant):
    scene = stating(plant(cameras=2).truth, focal=[0.05, 0.0])
    layout = Layout.create(scene, ("focal",))

    (given,) = expectations(scene, layout, Expectations(focal=0.2))
    (stated,) = expectations(scene, layout, Expectations())

    assert isinstance(given, GlobalPrior)
    assert given.sigma.tolist() == [0.05, 0.2]
    assert stated.sigma.tolist() == [0.05, torch.inf]
    value, jacobian, _ = stated.residuals(changed(scene, focal=1.1 * scene.cameras.focal), layout)
    assert value[:, 0].tolist() == pytest.approx([torch.tensor(1.1).log().item() / 0.05, 0.0], rel=1e-6)
    assert jacobian[:, 0, 0].tolist() == pytest.approx([20.0, 0.0])


def test_how_well_each_camera_is_determined_is_said_by_its_name(plant):
    planted = plant(views=6, points=60, cameras=2, noise=0.3)
    scene = stating(planted.truth, focal=[0.05, 0.0])
    named = replace(scene, cameras=replace(scene.cameras, names=("phone", "gopro")))
    report = planted.adjusted(named, terms=[planted.gravity], pixel_sigma=0.3)

    found = determinations(report.problem, report.scene, 0.3)
    known = uncertainty(report.problem, report.scene, 0.3)

    (focal,) = (one for one in found if one.name == "focal")
    assert focal.sentence.startswith("focal length of phone, relative: determined to 0.00")
    assert focal.sentence.endswith("(known to 0.05 before)")
    assert 0.0 < float(known.intrinsics["focal"][0]) < 0.05
    assert float(known.intrinsics["focal"][1]) == 0.0


def test_coefficients_beyond_the_fifth_stay_as_stated_and_that_is_said(plant):
    planted = plant(views=6, points=60, cameras=2)
    distortion = torch.zeros(2, 8, dtype=torch.float64)
    distortion[0, 5:] = torch.tensor([0.02, -0.01, 0.003])
    start = stating(changed(planted.truth, distortion=distortion), distortion=[0.05, 0.05])
    start = replace(start, cameras=replace(start.cameras, names=("phone", "gopro")))

    report = planted.adjusted(start, terms=[planted.gravity], pixel_sigma=0.1)

    found = report.scene.cameras.distortion
    assert torch.equal(found[:, 5:], distortion[:, 5:])
    assert bool((found[0, :5] != 0.0).all())  # these make up for it
    assert coefficients_as_stated(report.problem.layout, report.scene.cameras) == {
        "k4_to_k6 of phone": "k4 to k6 of phone: as stated, for nothing tells them from k1 to k3"
    }
    assert coefficients_as_stated(Layout.create(planted.truth), start.cameras) == {}


def test_the_images_say_what_they_wish_of_each_camera_that_is_exact(plant):
    planted = plant(views=6, points=80, cameras=2, noise=0.1)
    wrong = planted.truth.cameras.focal * torch.tensor([[1.0], [1.03]], dtype=torch.float64)
    start = stating(changed(planted.truth, focal=wrong), focal=[0.01, 0.0])
    report = planted.adjusted(start, terms=[planted.gravity], pixel_sigma=0.1)

    wished = wished_changes(report.problem, report.scene, "focal", 0.1)

    assert set(wished) == {"focal of 1"}
    step, sigma = wished["focal of 1"]
    assert step < -3.0 * sigma
    assert step == pytest.approx(-0.03, abs=0.02)


def test_a_single_pose_is_adjusted_with_cameras_as_they_are(plant):
    planted = plant(views=1, points=30, noise=0.5)
    start = stating(planted.truth, focal=[0.1])

    assert torch.equal(adjust_pose(start, BundleOptions()).scene.cameras.focal, start.cameras.focal)


def test_the_gradient_of_an_adjustment_knows_what_is_held(plant, squared):
    planted = plant(views=5, points=30, cameras=2, noise=0.3)
    options = replace(squared, pixel_sigma=0.3)
    start = stating(planted.truth, focal=[0.05, 0.0])
    terms = [planted.gravity]
    start = adjust(planted.seen_in(start), options, terms=terms).scene
    pixels = planted.observations.pixels.clone().requires_grad_()

    def focal(pixels):
        seen = replace(planted.observations, pixels=pixels)
        return adjust_differentiably(changed(start, observations=seen), options, terms=terms).cameras.focal

    direction, step = torch.linspace(-1.0, 1.0, pixels.numel(), dtype=torch.float64).view_as(pixels), 1e-3
    (gradient,) = torch.autograd.grad(focal(pixels)[0, 0], pixels)
    ahead, behind = (focal(planted.observations.pixels + sign * step * direction) for sign in (1.0, -1.0))
    expected = float(ahead[0, 0] - behind[0, 0]) / (2.0 * step)
    assert float((gradient * direction).sum()) == pytest.approx(expected, rel=1e-3)
    assert torch.equal(ahead[1], start.cameras.focal[1])
