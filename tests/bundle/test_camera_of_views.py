"""Each view of a scene has its own camera and its own interface."""

from dataclasses import replace

import pytest
import torch

from tests.bundle.changes import changed
from tests.tolerances import assert_same_pixels
from torchrefrac.camera import RefractiveCamera
from torchrefrac.geometry import Plane
from torchrefrac.refraction import FlatInterface
from torchrefrac.scene import Interfaces


def test_the_camera_of_a_view_has_its_intrinsics_and_its_water(plant):
    scene = plant(cameras=2, interfaces=2).truth
    views = torch.tensor((3, 0, 2))

    pixels, _ = scene.camera_of(views).project(scene.points[:3])

    for view, point, pixel in zip(views.tolist(), scene.points[:3], pixels, strict=True):
        group, level = int(scene.views.camera[view]), int(scene.views.interface[view])
        plane = Plane(scene.interfaces.normal[level], scene.interfaces.offset[level])
        rotation, center = scene.views.rotation[view], scene.views.center[view]
        alone = RefractiveCamera(scene.cameras[group], rotation, center, FlatInterface(1.33, plane=plane))
        assert_same_pixels(pixel, alone.project(point)[0])


def test_one_camera_and_one_water_serve_all_views(plant):
    views = plant().truth.views

    assert views.camera.tolist() == views.interface.tolist() == [0, 0, 0, 0]


def test_level_water_lies_at_height_zero():
    assert Interfaces.level(1.33).normal.tolist() == [[0.0, 0.0, 1.0]]
    assert Interfaces.level(1.33).offset.tolist() == [0.0]


@pytest.mark.parametrize("name", ["normal", "offset"])
def test_level_water_too_has_derivatives(plant, name):
    scene = plant().truth
    value = getattr(scene.interfaces, name).clone().requires_grad_()

    pixels, _ = changed(scene, **{name: value}).camera_of().project(scene.points[0])

    assert torch.autograd.grad(pixels.sum(), value)[0].abs().amax() > 0.0


def test_a_detached_scene_has_no_graph_and_the_same_numbers(plant):
    scene = plant(cameras=2, interfaces=2).truth
    center, focal = scene.views.center.clone().requires_grad_(), scene.cameras.focal.clone().requires_grad_()
    seen = replace(scene.observations, pixels=scene.observations.pixels.clone().requires_grad_())

    found = changed(scene, center=2.0 * center, focal=focal, observations=seen).detached()

    for value in (found.views.center, found.cameras.focal, found.observations.pixels):
        assert not value.requires_grad
    assert torch.equal(found.views.center, 2.0 * scene.views.center)
    assert torch.equal(found.cameras.focal, scene.cameras.focal)
