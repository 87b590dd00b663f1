"""Metrics against truth, on errors that were planted."""

import json
from dataclasses import replace

import pytest
import torch

from torchrefrac.camera import Intrinsics
from torchrefrac.evaluate.metrics import evaluate, summarize
from torchrefrac.evaluate.true_surface import distance_to_rectangles
from torchrefrac.files.library import embedded_scene
from torchrefrac.files.truth import load_truth
from torchrefrac.geometry import Rigid, Similarity, heading_rotation, so3_exp
from torchrefrac.scene import Assessment, Interfaces, Observations, Scene, Truth

DOUBLE = torch.float64


@pytest.fixture
def truth():
    return load_truth(embedded_scene("tank_small"))


@pytest.fixture
def perfect(truth: Truth):
    """The scene that is the truth, with points on the true surfaces."""
    s = torch.linspace(0.1, 0.9, 5, dtype=DOUBLE)
    grid = torch.cartesian_prod(s, s)
    points = truth.corner[:, None] + grid[:, :1] * truth.edge1[:, None] + grid[:, 1:] * truth.edge2[:, None]
    points = points.flatten(0, 1)
    pose, water = Rigid(truth.rotation, truth.center), Interfaces.level(1.33)
    intrinsics = Intrinsics.create(640, 480, 417.0)
    return Scene.create(pose, intrinsics, water, points, Observations.none(), names=truth.names, length_unit="cm")


def _moved(scene, change):
    views = scene.views.at(change.apply_to_rotation(scene.views.rotation), change.apply(scene.views.center))
    return replace(scene, views=views, points=change.apply(scene.points))


def _with_views(scene, registered=None, center=None):
    views = scene.views
    pose = Rigid(views.rotation, views.center if center is None else center)
    return replace(
        scene, views=replace(views, pose=pose, registered=views.registered if registered is None else registered)
    )


def _four_dof():
    shift = torch.tensor((3.0, -7.0, 0.0), dtype=DOUBLE)
    return Similarity(torch.tensor(0.3, dtype=DOUBLE), heading_rotation(torch.tensor(1.1, dtype=DOUBLE)), shift)


def _tilt():
    omega = torch.tensor((0.1, 0.0, 0.0), dtype=DOUBLE)
    return Similarity(torch.ones((), dtype=DOUBLE), so3_exp(omega), torch.tensor((0.0, 0.0, 5.0), dtype=DOUBLE))


def test_what_cannot_be_seen_through_water_counts_as_no_error(perfect, truth):
    found, _ = evaluate(_moved(perfect, _four_dof()), truth)
    assert found["alignment"] == "4-dof"
    for key in ("camera_rms_cm", "camera_max_cm", "camera_rotation_rms_deg", "surface_rms_cm"):
        assert found[key] == pytest.approx(0.0, abs=1e-5), key


def test_a_tilted_refractive_frame_is_an_error(perfect, truth):
    found, _ = evaluate(_moved(perfect, _tilt()), truth)
    assert found["camera_rms_cm"] > 1.0
    assert found["camera_rotation_rms_deg"] > 1.0


def test_a_tilted_frame_without_refraction_is_none(perfect, truth):
    found, _ = evaluate(replace(_moved(perfect, _tilt()), interfaces=Interfaces.level(1.0)), truth)
    assert found["alignment"] == "similarity"
    assert found["camera_rms_cm"] == pytest.approx(0.0, abs=1e-9)


def test_one_displaced_camera_is_measured(perfect, truth):
    center = perfect.views.center.clone()
    center[0, 2] += 0.8
    found, alignment = evaluate(_with_views(perfect, center=center), truth)
    distance = (alignment.apply(center) - truth.center).norm(dim=-1)
    assert found["camera_rms_cm"] == pytest.approx(float(distance.square().mean().sqrt()))
    assert 0.2 < found["camera_rms_cm"] <= 0.8 / 8**0.5 + 1e-9


def test_unregistered_images_take_no_part(perfect, truth):
    registered, center = perfect.views.registered.clone(), perfect.views.center.clone()
    registered[3], center[3] = False, 1e6
    found, _ = evaluate(_with_views(perfect, registered, center), truth)
    assert found["camera_rms_cm"] == pytest.approx(0.0, abs=1e-9)
    assert summarize(_with_views(perfect, registered))["registered_images"] == 7


def test_too_few_cameras_give_no_figures(perfect, truth):
    registered = torch.zeros_like(perfect.views.registered)
    registered[0] = True
    found, alignment = evaluate(_with_views(perfect, registered), truth)
    assert found == {"true_index_ratio": 1.33, "alignment": "none: too few registered cameras"}
    assert alignment is None


def test_distance_to_a_rectangle_ends_at_its_border(truth):
    bottom = replace(truth, corner=truth.corner[:1], edge1=truth.edge1[:1], edge2=truth.edge2[:1])
    points = torch.tensor([[0.0, 0.0, -97.0], [104.0, 0.0, -100.0], [103.0, 0.0, -96.0]], dtype=DOUBLE)
    assert distance_to_rectangles(points, bottom).tolist() == pytest.approx([3.0, 4.0, 5.0])


def test_what_is_known_of_the_errors_is_in_the_summary_with_its_units(perfect):
    sigma = torch.tensor((0.3, 0.1, 0.2), dtype=DOUBLE)
    known = Assessment(
        pixel_sigma=0.41,
        point_covariance=torch.eye(3, dtype=DOUBLE) * sigma.square()[:, None, None],
        center_sigma=10.0 * sigma,
        index_ratio_sigma=0.002,
        determined=("index ratio: determined to 0.002", "scale, relative: not determined"),
        fixed={"focal": "focal length, relative: not determined"},
    )

    found = summarize(replace(perfect, assessment=known))

    assert found["pixel_sigma_px"] == 0.41
    assert found["point_sigma_median_cm"] == pytest.approx(0.2)
    assert found["camera_sigma_median_cm"] == pytest.approx(2.0)
    assert found["index_ratio_sigma"] == 0.002
    assert found["determined"] == ["index ratio: determined to 0.002", "scale, relative: not determined"]
    assert found["held"] == {"focal": "focal length, relative: not determined"}
    assert json.loads(json.dumps(found)) == found


def test_where_nothing_is_known_of_the_errors_the_summary_has_nothing(perfect):
    keys = {"pixel_sigma_px", "point_sigma_median_cm", "camera_sigma_median_cm", "index_ratio_sigma"}
    keys |= {"determined", "held"}

    assert not keys & set(summarize(perfect))
    none = Assessment(point_covariance=torch.zeros(0, 3, 3, dtype=DOUBLE), center_sigma=torch.zeros(0, dtype=DOUBLE))
    assert not keys & set(summarize(replace(perfect, assessment=none)))
