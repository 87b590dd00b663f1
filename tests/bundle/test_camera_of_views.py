"""What an adjustment starts from."""

from dataclasses import replace

import pytest
import torch

from tests.tolerances import assert_same_pixels
from torchrefrac.bundle import BundleState, Links
from torchrefrac.camera import RefractiveCamera
from torchrefrac.geometry import Plane
from torchrefrac.refraction import FlatInterface


def test_without_a_plane_the_water_is_level_at_height_zero(plant):
    truth = plant().truth

    state = BundleState(truth.rotation, truth.center, truth.points, truth.lens, truth.index_ratio)

    assert state.planes[0].tolist() == [[0.0, 0.0, 1.0]]
    assert state.planes[1].tolist() == [0.0]


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"normal": torch.tensor([[0.0, 0.0, 1.0]])}, "normal is given without offset, but a water plane needs both"),
        ({"offset": torch.tensor([1.0])}, "offset is given without normal, but a water plane needs both"),
    ],
)
def test_half_a_plane_is_refused(plant, given, message):
    truth = plant().truth

    with pytest.raises(ValueError, match=message):
        BundleState(truth.rotation, truth.center, truth.points, truth.lens, truth.index_ratio, **given)


def test_the_camera_of_an_image_has_its_lens_and_its_water(plant):
    planted = plant(lenses=2, planes=2)
    state, links = planted.truth, planted.links
    images = torch.tensor((3, 0, 2))

    pixels, _ = state.cameras(links, images).project(state.points[:3])

    for image, point, pixel in zip(images.tolist(), state.points[:3], pixels, strict=True):
        group, level = int(links.lens[image]), int(links.plane[image])
        lens = replace(state.lens, **{name: getattr(state.lens, name)[group] for name in _PARTS})
        water = FlatInterface(1.33, plane=Plane(state.planes[0][level], state.planes[1][level]))
        alone = RefractiveCamera(lens, state.rotation[image], state.center[image], water)
        assert_same_pixels(pixel, alone.project(point)[0])


def test_one_lens_and_one_water_serve_all_images(plant):
    links = Links.single(plant().truth)

    assert links.lens.tolist() == links.plane.tolist() == [0, 0, 0, 0]


def test_a_detached_state_has_no_graph_and_the_same_numbers(plant):
    truth = plant(lenses=2, planes=2).truth
    center = truth.center.clone().requires_grad_()
    lens = replace(truth.lens, focal=truth.lens.focal.clone().requires_grad_())

    state = replace(truth, center=2.0 * center, lens=lens).detached()

    assert not state.center.requires_grad
    assert not state.lens.focal.requires_grad
    assert torch.equal(state.center, 2.0 * truth.center)
    assert torch.equal(state.lens.focal, truth.lens.focal)


_PARTS = ("focal", "principal_point", "distortion")
