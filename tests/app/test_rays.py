"""A run as a data set of rays."""

import json
import shutil

import cv2
import numpy as np
import pytest
import torch

import torchrefrac as tr
from torchrefrac.commands.densify import OptionError


@pytest.fixture
def rays(sparse, tmp_path):
    """`rays(...)`: `RefractiveRays` of the sparse run of three photographs, with a cache of its own."""
    return lambda *given, **options: tr.RefractiveRays(sparse / "run", *given, cache=tmp_path / "cache", **options)


def _photograph(sparse, name):
    return cv2.cvtColor(cv2.imread(str(sparse / "capture" / "images" / name)), cv2.COLOR_BGR2RGB)


def test_a_point_on_a_ray_is_seen_by_its_pixel(sparse, rays):
    data = rays(dtype=torch.float64)

    found = data[torch.arange(0, len(data), 1009)]

    cameras = tr.load_cameras(sparse / "run")
    row = torch.tensor([cameras.names.index(name) for name in data.names])[found.view]
    for depth in (0.5, 20.0):
        pixels, valid = cameras[row].project(found.refrax + depth * found.direction)
        assert valid.all()
        assert found.mask.all()
        torch.testing.assert_close(pixels, found.pixel, rtol=0.0, atol=1e-6)
    torch.testing.assert_close(found.origin, cameras.center_in_world[row])
    assert found.refrax[:, 2].abs().max() < 1e-9


def test_points_along_a_ray_bend_at_the_water(rays):
    found = rays(dtype=torch.float64)[torch.tensor([5, 70_000])]

    points = found.at(torch.tensor([[-3.0, 0.0, 2.0]] * 2, dtype=torch.float64))

    torch.testing.assert_close(points[:, 1], found.refrax)
    torch.testing.assert_close(points[:, 2], found.refrax + 2.0 * found.direction)
    before = points[:, 1] - points[:, 0]
    torch.testing.assert_close(before.norm(dim=-1), torch.full((2,), 3.0, dtype=torch.float64))
    across = torch.linalg.cross(before, found.refrax - found.origin).norm(dim=-1)
    assert across.max() < 1e-9


def test_without_refraction_rays_are_straight_from_the_cameras(sparse, tmp_path):
    run = shutil.copytree(sparse / "run", tmp_path / "run")
    path = run / "cameras.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"index_ratio": 1.0}))
    data = tr.RefractiveRays(run, cache=tmp_path / "cache", dtype=torch.float64)

    found = data[torch.tensor([5, 70_000])]

    assert torch.equal(found.refrax, found.origin)
    pixels, _ = data.cameras[found.view].as_pinhole().project(found.origin + 3.0 * found.direction)
    torch.testing.assert_close(pixels, found.pixel, rtol=0.0, atol=1e-6)
    assert found.mask.all()


def test_colors_are_those_of_the_photographs(sparse, rays):
    data = rays("all")

    for view, name in enumerate(data.names):
        whole = data.image(view)
        photograph = torch.from_numpy(_photograph(sparse, name)) / 255.0
        assert torch.equal(whole.color, photograph)
        assert whole.origin.shape == (240, 320, 3)
        one = data[240 * 320 * view + 320 * 17 + 40]
        assert torch.equal(one.color, photograph[17, 40])
        assert one.pixel.tolist() == [40.5, 17.5]
        assert int(one.view) == view
        assert torch.equal(whole.refrax[17, 40], one.refrax)


def test_photographs_are_trained_on_or_tested_by(rays):
    names = rays("all").names

    assert rays("test", holdout=2).names == (names[0], names[2])
    assert rays("train", holdout=2).names == (names[1],)
    assert rays("test", holdout=[names[1]]).names == (names[1],)
    assert rays().names == names[1:]
    assert len(rays()) == 2 * 320 * 240


def test_smaller_photographs_have_the_means_of_their_pixels(sparse, rays):
    data = rays("all", smaller=4)

    whole = data.image(1)

    photograph = _photograph(sparse, data.names[1]).reshape(60, 4, 80, 4, 3).mean(axis=(1, 3))
    assert whole.color.shape == (60, 80, 3)
    assert np.abs(255.0 * whole.color.numpy() - photograph).max() <= 0.5001
    assert whole.pixel[0, 0].tolist() == [2.0, 2.0]
    assert whole.pixel[-1, -1].tolist() == [318.0, 238.0]


def test_masked_pixels_are_not_to_be_used(sparse, tmp_path):
    capture = shutil.copytree(sparse / "capture", tmp_path / "capture")
    name = json.loads((capture / "capture.json").read_text())["images"][0]["name"]
    mask = np.full((240, 320), 255, np.uint8)
    mask[:100, :41] = 0
    (capture / "masks").mkdir()
    cv2.imwrite(str(capture / "masks" / f"{name}.png"), mask)

    options = {"capture": capture, "cache": tmp_path / "cache"}
    whole = tr.RefractiveRays(sparse / "run", "test", **options).image(0)
    small = tr.RefractiveRays(sparse / "run", "test", smaller=4, **options).image(0)

    assert torch.equal(whole.mask, torch.from_numpy(mask > 0))
    assert torch.equal(
        ~small.mask,
        torch.zeros(60, 80, dtype=torch.bool).index_put(
            (torch.arange(25)[:, None], torch.arange(11)), torch.tensor(True)
        ),
    )


@pytest.mark.parametrize("workers", [0, 2])
def test_every_ray_is_met_once_in_an_epoch_and_every_epoch_has_an_order_of_its_own(rays, workers):
    data = rays("test", smaller=2)
    loader = data.loader(1000, workers=workers, seed=4)

    first, second = ([torch.cat(part) for part in zip(*(batch for batch in loader), strict=True)] for _ in range(2))

    assert len(loader) == 20
    orders = [(one[6][:, 1] // 2) * 160 + one[6][:, 0] // 2 for one in (first, second)]
    for order in orders:
        assert order.sort().values.tolist() == list(range(120 * 160))
    assert (orders[0] == orders[1]).double().mean() < 0.01
    expected = tr.Rays(*first)
    assert torch.equal(expected.color, data[orders[0].long()].color)
    again = next(iter(data.loader(1000, seed=4)))
    assert torch.equal(again.pixel, first[6][:1000])


def test_without_shuffling_rays_come_row_by_row(rays):
    data = rays("test")

    batch = next(iter(data.loader(7, shuffle=False)))

    assert batch.pixel[:, 0].tolist() == [0.5, 1.5, 2.5, 3.5, 4.5, 5.5, 6.5]


def test_pixels_are_written_once(rays, tmp_path):
    first = rays("test")
    (file,) = (tmp_path / "cache").glob("*.npy")
    before = file.stat().st_mtime_ns

    second = rays("test")

    assert file.stat().st_mtime_ns == before
    assert torch.equal(first.image(0).color, second.image(0).color)


def test_a_split_without_photographs_is_refused(rays):
    with pytest.raises(ValueError, match=r"no photograph of .* is of the split 'test'; holdout is \[\]"):
        rays("test", holdout=[])
    with pytest.raises(ValueError, match="split is 'val', but must be one of train, test, all"):
        rays("val")
    with pytest.raises(IndexError, match="ray 153600 of 153600"):
        rays()[153600]


def test_a_folder_that_is_no_run_is_refused(tmp_path):
    with pytest.raises(OptionError, match="which is no folder"):
        tr.RefractiveRays(tmp_path / "nothing")
