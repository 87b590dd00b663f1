"""Photographs: colours, light, reflection and samples, each against one ray by hand."""

from dataclasses import replace

import pytest
import torch

from torchrefrac.camera import Intrinsics, RefractiveCamera
from torchrefrac.refraction import FlatInterface
from torchrefrac.synthetic import photograph
from torchrefrac.synthetic.photograph import Photographer
from torchrefrac.synthetic.sight import see
from torchrefrac.synthetic.waves import reflectance

IMAGE = 1


def lens_of(options):
    camera = options.camera
    return Intrinsics.create(camera.width, camera.height, camera.focal, distortion=camera.distortion)


def sight_of_pixels(stage, options):
    """What the centre of each pixel sees, by the camera of the package."""
    interface = FlatInterface(options.index_ratio)
    camera = RefractiveCamera(lens_of(options), stage.rotation[IMAGE], stage.center[IMAGE], interface)
    return see(stage.pieces, camera, lens_of(options).pixel_grid().flatten(0, 1))


def by_hand(stage, sight):
    """Colours (N, 3) of rays, one after another."""
    light = torch.nn.functional.normalize(torch.tensor(stage.towards_light).double(), dim=-1)
    colors = []
    for piece, uv, normal in zip(sight.piece.tolist(), sight.uv, sight.normal, strict=True):
        if piece < 0:
            colors.append(torch.full((3,), stage.background))
        else:
            shade = stage.ambient + stage.direct * abs(float(normal @ light))
            colors.append(stage.pieces[piece].texture(uv[None])[0] * shade)
    return torch.stack(colors)


def test_one_ray_a_pixel_has_the_colour_of_what_the_centre_sees_in_its_light(stage, calm):
    image = Photographer.of(stage, calm).take(IMAGE)

    assert image.dtype == torch.float32
    assert image.shape == (36, 48, 3)
    assert torch.allclose(image.flatten(0, 1), by_hand(stage, sight_of_pixels(stage, calm)), atol=1e-3)


def test_the_water_mirrors_by_fresnels_share(stage, calm):
    image = Photographer.of(stage, replace(calm, reflection=250.0)).take(IMAGE)

    sight = sight_of_pixels(stage, calm)
    share = torch.where(sight.in_water, reflectance(sight.cosine, calm.index_ratio), 0.0)[:, None]
    below = by_hand(stage, sight)
    assert 0 < int((~sight.in_water).sum()) < 500
    assert torch.allclose(image.flatten(0, 1), ((1 - share) * below + share * 250.0).float(), atol=1e-3)


def test_a_pixel_is_the_mean_of_the_middles_of_its_parts(stage, options):
    image = Photographer.of(stage, options).take(IMAGE)

    fine = replace(lens_of(options), width=96, height=72)
    fine = replace(fine, focal=2.0 * fine.focal, principal_point=2.0 * fine.principal_point)
    single = Photographer(stage, Photographer.of(stage, options).scenery, fine, samples=1).take(IMAGE)
    assert torch.allclose(image, single.reshape(36, 2, 48, 2, 3).mean(dim=(1, 3)), atol=1e-3)


def test_neither_tiles_nor_threads_nor_kept_rays_change_a_photograph(stage, options, monkeypatch):
    photographer = Photographer.of(stage, options)
    whole, again = photographer.take(IMAGE), photographer.take(IMAGE)

    monkeypatch.setattr(photograph, "TILE_RAYS", 500)
    monkeypatch.setattr(photograph, "READY_BYTES", 0)
    threads = torch.get_num_threads()
    try:
        torch.set_num_threads(2)
        tiled = Photographer.of(stage, options).take(IMAGE)
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(threads)

    assert torch.equal(whole, again)
    assert torch.allclose(whole, tiled, atol=1e-4)


def test_where_nothing_is_met_there_is_the_background(stage, calm):
    bare = replace(stage, pieces=stage.pieces[3:], background=77.0)

    image = Photographer.of(bare, calm).take(IMAGE)

    assert image[0, 0].tolist() == pytest.approx([77.0] * 3)
