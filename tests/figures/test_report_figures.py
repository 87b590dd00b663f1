"""What the figures of a report are drawn from, against sums of another kind."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.html.html_runs import Planted
from torchrefrac.camera import Intrinsics
from torchrefrac.figures.attitude import attitudes, wrapped
from torchrefrac.figures.cameras import pyramids
from torchrefrac.figures.residuals import Residuals, bins
from torchrefrac.figures.shift import shift_images, shift_map, typical_depth
from torchrefrac.figures.uncertainty import ellipse_axes, exaggeration, true_errors
from torchrefrac.files.capture import load_capture
from torchrefrac.files.library import embedded_scene
from torchrefrac.files.truth import load_truth
from torchrefrac.geometry import Rigid, heading_rotation, level_rotation, split_heading
from torchrefrac.scene import Interfaces, Observations, Scene, Truth

INDEX_RATIO = 1.33


@pytest.fixture
def planted(tmp_path, generator):
    """The embedded tank as `html_runs` plants it."""
    return Planted(tmp_path, generator).scene(INDEX_RATIO)


@pytest.fixture
def make_scene(draw):
    """`make_scene(rotation)`: cameras of these rotations (m, 3, 3), 30 above the water, with a point below each."""

    def make(rotation):
        m = len(rotation)
        center = torch.cat((draw.uniform(-20.0, 20.0, m, 2), torch.full((m, 1), 30.0, dtype=torch.float64)), dim=1)
        below = center - torch.tensor((0.0, 0.0, 80.0), dtype=torch.float64)
        every = torch.arange(m)
        return Scene.create(
            Rigid(rotation, center), Intrinsics.create(640, 480, 400.0), Interfaces.level(INDEX_RATIO), below,
            Observations(every, every, torch.zeros(m, 2, dtype=torch.float64)), length_unit="cm",
        )  # fmt: skip

    return make


def _tilted(roll_deg, pitch_deg, heading):
    """cam_from_world of cameras whose right and lower sides dip by these angles."""
    x, y = torch.deg2rad(roll_deg).sin(), torch.deg2rad(pitch_deg).sin()
    down = torch.stack((x, y, (1.0 - x * x - y * y).sqrt()), dim=-1)
    return level_rotation(down) @ heading_rotation(heading)


def test_attitudes_are_the_planted_ones_and_headings_are_compared_but_for_their_mean(draw, make_scene):
    roll, pitch, heading = draw.uniform(-5.0, 5.0, 6), draw.uniform(0.0, 40.0, 6), draw.uniform(-3.0, 3.0, 6)
    scene = make_scene(_tilted(roll, pitch, heading))
    error = draw.normal(3, 6)
    true = _tilted(roll - error[0], pitch - error[1], heading - torch.deg2rad(error[2]) - 2.5)
    none = torch.zeros(0, 3, dtype=torch.float64)
    truth = Truth(scene.views.names, true, scene.views.center, none, none, none, "cm")

    images, (rolls, pitches, headings) = attitudes(scene, None, truth)

    assert images.tolist() == list(range(6))
    assert torch.allclose(rolls.estimated, roll)
    assert torch.allclose(pitches.estimated, pitch)
    assert torch.allclose(rolls.error(rolls.true), error[0])
    assert torch.allclose(pitches.error(pitches.true), error[1])
    assert torch.allclose(headings.error(headings.true), error[2] - error[2].mean(), atol=1e-3)
    assert rolls.measured is None
    assert headings.error(headings.measured) is None


def test_headings_run_on_where_the_compass_begins_anew(make_scene):
    level = torch.zeros(8, dtype=torch.float64)

    _, (*_, headings) = attitudes(
        scene := make_scene(_tilted(level, level, torch.arange(8, dtype=torch.float64))),
        None,
        Truth(
            scene.views.names,
            scene.views.rotation,
            scene.views.center,
            *[torch.zeros(0, 3, dtype=torch.float64)] * 3,
            "cm",
        ),
    )

    assert torch.allclose(headings.estimated.diff(), torch.tensor(180.0 / math.pi, dtype=torch.float64))
    assert torch.allclose(headings.true, headings.estimated)


def test_measured_angles_are_set_beside_registered_images_alone(planted):
    capture = load_capture(embedded_scene("tank_small"))
    heading = split_heading(planted.views.rotation)[1] + 3.0
    with_heading = replace(capture, heading=heading, has_heading=torch.ones(8, dtype=torch.bool))

    images, angles = attitudes(planted, capture, None)
    _, (*_, heading) = attitudes(planted, with_heading, None)

    assert images.tolist() == list(range(7))
    assert [angle.name for angle in angles] == ["roll", "pitch"]
    assert torch.allclose(heading.measured, heading.estimated)
    expected = np.degrees(np.arcsin(capture.down_in_cam[:7, 0].numpy()))
    assert angles[0].measured.numpy() == pytest.approx(expected)


def test_angles_wrap_at_half_a_turn():
    assert wrapped(torch.tensor([190.0, -190.0, 10.0, 720.0])).tolist() == [-170.0, 170.0, 10.0, 0.0]


def test_residuals_are_those_of_the_noise_and_every_observation_is_in_one_bin(planted):
    residuals = Residuals.of(planted)

    step, start, rows = bins(residuals.incidence)

    assert len(residuals) == len(planted.observations)
    assert float(residuals.error.median()) == pytest.approx(0.5 * math.sqrt(2.0 * math.log(2.0)), rel=0.2)
    assert sum(len(residuals.of_image(i)) for i in range(8)) == len(residuals)
    every = torch.cat(list(rows.values()))
    assert len(every.unique()) == len(every)
    for k, chosen in rows.items():
        inside = residuals.incidence[chosen]
        assert float(inside.min()) >= start + k * step
        assert float(inside.max()) <= start + (k + 1) * step


def test_the_angle_of_incidence_is_that_of_the_viewing_ray(planted):
    residuals = Residuals.of(planted)
    camera = planted.camera_of(planted.observations.view)
    projected, _ = camera.project(planted.points[planted.observations.point])

    upwards = -camera.view_directions(projected)[:, 2]

    assert torch.allclose(residuals.incidence, upwards.acos().rad2deg(), atol=1e-6)


def test_the_shift_below_a_camera_that_looks_straight_down_follows_from_snells_law(make_scene):
    level = torch.zeros(1, dtype=torch.float64)
    scene = make_scene(_tilted(level, level, level))

    pixels, shift, valid = shift_map(scene, 0, 50.0)

    from_middle = pixels.numpy() - np.array((320.0, 240.0))
    radius = np.linalg.norm(from_middle, axis=-1)
    air = np.arctan(radius / 400.0)
    water = np.arcsin(np.sin(air) / INDEX_RATIO)
    straight = 400.0 * (30.0 * np.tan(air) + 50.0 * np.tan(water)) / 80.0
    assert valid.all()
    assert np.linalg.norm(shift.numpy(), axis=-1) == pytest.approx(radius - straight, abs=1e-8)
    assert ((shift.numpy() * from_middle).sum(axis=-1) >= 0.0).all()


def test_shift_is_shown_of_the_most_oblique_image_too_where_that_is_another_matter(make_scene):
    flat = torch.zeros(5, dtype=torch.float64)
    pitch = torch.tensor((10.0, 11.0, 12.0, 13.0, 40.0), dtype=torch.float64)

    assert shift_images(make_scene(_tilted(flat, pitch, flat))) == [2, 4]
    assert shift_images(make_scene(_tilted(flat, pitch.clamp(max=14.0), flat))) == [2]


def test_the_typical_depth_is_that_of_points_in_the_water():
    points = torch.tensor([[0.0, 0.0, z] for z in (5.0, 9.0, -10.0, -20.0, -90.0)], dtype=torch.float64)

    def depth(chosen):
        return typical_depth(type("Scene", (), {"points": chosen})())

    assert depth(points) == 20.0
    assert depth(points[:2]) == 0.0


def test_the_edges_of_a_pyramid_are_seen_in_the_corners_of_the_image(planted):
    lines = pyramids(planted).unflatten(0, (7, 4))
    cameras = planted.camera_of().as_pinhole()[:7]

    pixels, _ = cameras[:, None].project(lines[:, :, 1])

    corners = torch.tensor(((0.0, 0.0), (640.0, 0.0), (640.0, 480.0), (0.0, 480.0)), dtype=torch.float64)
    assert torch.allclose(pixels, corners.expand_as(pixels), atol=1e-6)
    assert torch.equal(lines[:, :, 0], planted.views.center[:7, None].expand(7, 4, 3))


def test_ellipses_have_the_axes_that_made_them(draw):
    long, short = draw.uniform(2.0, 3.0, 10), draw.uniform(0.5, 1.0, 10)
    angle = draw.uniform(-1.5, 1.5, 10)
    turn = torch.stack((angle.cos(), -angle.sin(), angle.sin(), angle.cos()), dim=-1).reshape(10, 2, 2)

    found = ellipse_axes(turn @ torch.diag_embed(torch.stack((long, short), dim=-1) ** 2) @ turn.mT)

    assert torch.allclose(found[0], long)
    assert torch.allclose(found[1], short)
    assert torch.allclose(torch.remainder(found[2] - angle.rad2deg() + 90.0, 180.0), torch.tensor(90.0).double())


@pytest.mark.parametrize(("size", "factor"), [(1e-3, 10000.0), (0.04, 200.0), (20.0, 1.0), (0.0, 1.0)])
def test_errors_are_exaggerated_by_a_round_factor_and_never_made_smaller(size, factor):
    assert exaggeration(size, 100.0) == factor


def test_true_errors_are_of_images_that_the_truth_has(planted):
    truth = load_truth(embedded_scene("tank_small"))
    assert truth is not None
    pose = Rigid(planted.views.rotation, truth.center + 1.0)
    shifted = replace(planted, views=replace(planted.views, pose=pose, names=("other.jpg", *truth.names[1:])))

    errors = true_errors(shifted, truth, torch.arange(3))

    assert bool(errors[0].isnan().all())
    assert torch.allclose(errors[1:], torch.ones(2, 3, dtype=torch.float64))
