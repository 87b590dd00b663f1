"""Reconstructions through a wall of glass and through ports, from tracks."""

import math
from dataclasses import replace

import pytest
import torch

from torchrefrac.evaluate.consistency import contradictions
from torchrefrac.features import build_tracks
from torchrefrac.geometry import align_above_plane, align_similarity, heading_rotation, so3_exp
from torchrefrac.recorder import SilentRecorder
from torchrefrac.scene import CaptureError, Interfaces, Scene, WarningCode
from torchrefrac.scene.interfaces import PORT, WALL
from torchrefrac.sfm import (
    PortInitializer,
    RefractiveInitializer,
    SfmOptions,
    facing_wall,
    gravity_in_world,
    reconstruct_sparse,
    verify_pairs,
    with_upright_wall,
)
from torchrefrac.sfm.frame import fix_frame

ONE = torch.ones(1, dtype=torch.float64)
GLASS = ONE[:, None] * 1.52
OPTIONS = SfmOptions()


def wall(index_ratio=1.33, thickness=1.2):
    return replace(Interfaces.level(index_ratio), layers=GLASS, thickness=thickness * ONE[:, None], kinds=(WALL,))


def port(index_ratio=1.33, tilt_deg=(1.0, -0.5)):
    turn = so3_exp(torch.tensor((*tilt_deg, 0.0), dtype=torch.float64).deg2rad())
    normal = (turn @ torch.tensor((0.0, 0.0, -1.0), dtype=torch.float64))[None]
    return Interfaces(normal, -2.0 * ONE, index_ratio * ONE, GLASS, 0.8 * ONE[:, None], (PORT,))


@pytest.fixture
def seen_through(survey_of, draw):
    """`seen_through(interfaces, noise)`: a survey whose tracks are seen through these."""

    def make(interfaces, noise=0.0, cameras=6, points=150):
        survey = survey_of(cameras=cameras, points=points)
        scene = replace(survey.scene(with_points=True), interfaces=interfaces)
        seen = survey.seen
        pixels, valid = scene.camera_of(seen.view).project(scene.points[seen.point], inside_image=True)
        rows = valid.nonzero()[:, 0]
        seen = replace(seen, pixels=pixels + noise * draw.normal(len(pixels), 2))[rows]
        capture = replace(survey.capture, interfaces=interfaces)
        return replace(survey, capture=capture, seen=seen, wrong=survey.wrong[rows])

    return make


def reconstructed(survey, make, stated=None, **changes):
    """The scene from a survey by an initializer, by what is stated of it."""
    capture = replace(survey.capture, interfaces=stated or survey.capture.interfaces, **changes)
    generator, features = torch.Generator().manual_seed(1), survey.features()
    initializer = make(capture, 1.33, OPTIONS)
    pairs = verify_pairs(survey.pairs(), features, initializer, OPTIONS.min_pair_inliers, generator, SilentRecorder())
    seen, colors = build_tracks(features, [pair.pair for pair in pairs])
    scene = Scene.of_capture(capture, seen, colors, initializer.index_ratio)
    return reconstruct_sparse(scene, capture, pairs, initializer, OPTIONS, generator, SilentRecorder())


def test_through_a_wall_cameras_are_exact_and_in_the_unit_of_the_glass(seen_through):
    survey = seen_through(wall())
    height = {"height": survey.basin.center[:, 2], "height_sigma": torch.full((6,), 1e-4).double()}

    scene = reconstructed(survey, RefractiveInitializer, **height)

    assert scene.views.registered.all()
    assert scene.interfaces.thickness.tolist() == [[1.2]]
    change = align_above_plane(scene.views.center, survey.basin.center)
    torch.testing.assert_close(change.apply(scene.views.center), survey.basin.center, rtol=0.0, atol=0.01)
    assert float(change.scale) == pytest.approx(1.0, abs=1e-3)


def test_glass_that_is_left_out_is_asked_for(seen_through):
    survey = seen_through(wall(thickness=3.0), noise=0.05)
    bare = replace(Interfaces.level(1.33), kinds=(WALL,))

    scene = reconstructed(survey, RefractiveInitializer, bare)

    step, sigma = scene.assessment.wished["layer_thickness"]
    assert step > 4.0 * sigma > 0.0
    findings = contradictions(scene, survey.capture)
    assert WarningCode.INDEX_CONTRADICTS in {finding.code for finding in findings}
    assert any("glass (index 1.52) before the water, but none is stated" in finding.message for finding in findings)


def test_behind_ports_cameras_are_exact_but_for_a_similarity(seen_through):
    survey = seen_through(port())

    scene = reconstructed(survey, PortInitializer)

    assert scene.views.registered.all()
    change = align_similarity(scene.views.center, survey.basin.center)
    torch.testing.assert_close(change.apply(scene.views.center), survey.basin.center, rtol=0.0, atol=0.01)
    points = change.apply(scene.points)
    nearest = torch.cdist(points, survey.basin.points).amin(dim=1)
    assert float(nearest.max()) < 0.05


def test_a_wall_faces_the_cameras_where_its_normals_are_stated(survey_of):
    capture = replace(survey_of().capture, interfaces=wall())
    level = replace(
        capture,
        down_in_cam=torch.tensor([[0.0, 1.0, 0.0]]).double().repeat(4, 1),
        normal_in_cam=-capture.down_in_cam,
        normal_sigma=torch.full((4,), 0.01).double(),
    )

    facing = facing_wall(level)

    torch.testing.assert_close(facing.down_in_cam, capture.down_in_cam)
    assert torch.equal(facing.gravity_in_cam, level.down_in_cam)
    assert facing.has_gravity
    assert facing_wall(survey_of().capture).gravity_in_cam.shape == (4, 3)


def test_photographs_that_look_down_at_a_wall_are_refused(survey_of):
    capture = replace(survey_of().capture, interfaces=wall())
    down = torch.tensor([[0.0, 0.0, 1.0]]).double().repeat(4, 1)

    with pytest.raises(CaptureError, match=r"0.jpg looks up or down, by its down_in_cam, but the interface is a wall"):
        facing_wall(replace(capture, down_in_cam=down))


def test_gravity_levels_the_directions_into_an_upright_wall(survey_of, draw):
    survey = survey_of()
    into = survey.basin.down_in_cam
    aside = torch.nn.functional.normalize(torch.linalg.cross(into, draw.directions(4), dim=-1), dim=-1)
    wrong = torch.nn.functional.normalize(into + 0.05 * aside, dim=-1)
    facing = replace(
        survey.capture,
        interfaces=wall(),
        down_in_cam=wrong,
        down_sigma=torch.full((4,), math.radians(5.0)).double(),
        gravity_in_cam=aside,
        gravity_sigma=torch.full((4,), math.radians(0.1)).double(),
    )

    level = with_upright_wall(facing).down_in_cam

    assert ((level * aside).sum(dim=-1).abs() < 0.05 * 0.1).all()
    torch.testing.assert_close(level.norm(dim=-1), torch.ones(4).double())


def test_before_a_wall_y_points_up(survey_of):
    survey = survey_of()
    scene = replace(survey.scene(with_points=True), interfaces=wall())
    gravity = heading_rotation(torch.tensor(2.0).double()) @ torch.tensor((1.0, 0.0, 0.0)).double()
    in_cam = scene.views.rotation @ gravity
    sigma = torch.full((4,), 0.01).double()
    capture = replace(survey.capture, interfaces=wall(), gravity_in_cam=in_cam, gravity_sigma=sigma)

    fixed = fix_frame(scene, capture)

    found, doubt = gravity_in_world(fixed, capture)
    torch.testing.assert_close(found, torch.tensor((0.0, -1.0, 0.0)).double(), rtol=0.0, atol=1e-12)
    assert doubt == pytest.approx(0.005)


def test_a_wall_that_gravity_does_not_find_upright_is_named(survey_of):
    survey = survey_of()
    scene = replace(survey.scene(with_points=True), interfaces=wall())
    tilted = torch.nn.functional.normalize(torch.tensor((0.0, -1.0, -0.3)).double(), dim=-1)
    sigma = torch.full((4,), 0.01).double()
    gravity = {"gravity_in_cam": scene.views.rotation @ tilted, "gravity_sigma": sigma}
    capture = replace(survey.capture, interfaces=wall(), **gravity)

    messages = [finding.message for finding in contradictions(scene, capture)]

    assert any("the wall is 16.7 degrees from upright by down_in_cam" in message for message in messages)
