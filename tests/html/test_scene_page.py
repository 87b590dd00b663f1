"""scene.html: what it shows, that it holds all of it, and that it stays small."""

import base64
import json
import re
from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.html.html_runs import Planted
from torchrefrac.files.dense import write_dense
from torchrefrac.html import write_report
from torchrefrac.html.contents import read_contents
from torchrefrac.html.scene_page import MOST_BYTES, write_scene_page
from torchrefrac.scene import DenseCloud, Interfaces

KINDS = {"positions": "<u2", "colors": "u1", "sigma": "u1", "map": "u1", "pyramids": "<f4"}


class Shown:
    """A page's numbers as a browser reads them: points and corners of cameras in the frame of the view, about what the
    view is turned round."""

    def __init__(self, path):
        self.page = path.read_text(encoding="utf-8")
        scripts = dict(re.findall(r'<script type="[^"]*" id="(\w+)">(.*?)</script>', self.page, re.DOTALL))
        self.about = json.loads(scripts["about"])
        for name, kind in KINDS.items():
            setattr(self, name, np.frombuffer(base64.b64decode(scripts[name]), kind))
        shares = self.positions.reshape(-1, 3) / 65535.0
        self.points = np.array(self.about["origin"]) + shares * np.array(self.about["extent"])


@pytest.fixture
def planted(tmp_path):
    return Planted(tmp_path, torch.Generator().manual_seed(3))


def cloud(points, sigma):
    n = len(points)
    generator = torch.Generator().manual_seed(4)
    colors = torch.randint(256, (n, 3), generator=generator).byte()
    ones, counts = torch.ones(n, dtype=torch.float64), torch.ones(n, dtype=torch.long)
    return DenseCloud(
        points, points.new_tensor((0.0, 0.0, 1.0)).expand(n, 3), colors, sigma, ones, counts, counts, sigma, "cm"
    )


def of(contents, **changes):
    """The page of a run whose scene has been changed."""
    return Shown(write_scene_page(replace(contents, scene=replace(contents.scene, **changes))))


def test_points_are_where_they_were_found_to_a_step_of_the_box_with_their_own_colours(planted):
    run = planted.complete("run")
    contents = read_contents(run, {})

    shown, scene = of(contents), contents.scene

    step = max(shown.about["extent"]) / 65535.0
    expected = scene.points - scene.points.mean(dim=0)
    assert np.abs(shown.points - shown.points.mean(axis=0) - expected.numpy()).max() <= step
    assert (shown.colors.reshape(-1, 3) == scene.colors.numpy()).all()
    assert not len(shown.sigma)
    assert f"7 cameras and {len(scene.points)} sparse points" in shown.page


def test_depth_is_that_below_the_water(planted):
    run = planted.complete("run")
    contents = read_contents(run, {})

    shown, scene = of(contents), contents.scene

    (scale,) = shown.about["scales"]
    depth = scale["sign"] * shown.points[:, scale["axis"]] + scale["middle"]
    assert np.abs(depth + scene.points[:, 2].numpy()).max() < 0.01
    assert scale["label"] == "Depth below the water surface (cm)"
    assert scale["reversed"]


def test_cameras_are_pyramids_with_their_tips_at_the_centres(planted):
    run = planted.complete("run")
    contents = read_contents(run, {})

    shown, scene = of(contents), contents.scene

    tips = shown.pyramids.reshape(-1, 5, 3)[:, 0]
    middle = scene.points.mean(dim=0).numpy() - shown.points.mean(axis=0)
    centers = scene.views.center[scene.views.registered].numpy()
    assert np.abs(tips + middle - centers).max() < 1e-2
    assert len(tips) == 7


def test_every_surface_that_stands_still_is_a_rectangle_in_its_plane_round_everything(planted):
    contents = read_contents(planted.complete("run"), {})
    normal = torch.tensor(((0.0, 0.0, 1.0), (0.6, 0.0, 0.8)), dtype=torch.float64)
    offset = torch.tensor((0.0, 2.0), dtype=torch.float64)
    planes = Interfaces(normal, offset, torch.full((2,), 1.33, dtype=torch.float64))

    shown = of(contents, interfaces=planes)

    corners = np.array(shown.about["surfaces"])
    middle = contents.scene.points.mean(dim=0).numpy() - shown.points.mean(axis=0)
    height = np.einsum("kni,ki->kn", corners + middle, normal.numpy())
    assert np.abs(height - offset.numpy()[:, None]).max() < 1e-2
    edges = np.roll(corners, -1, axis=1) - corners
    assert np.abs((edges * np.roll(edges, -1, axis=1)).sum(axis=-1)).max() < 1e-6
    low, high = corners[0].min(axis=0), corners[0].max(axis=0)
    assert (shown.points[:, :2] >= low[:2] - 1e-6).all()
    assert (shown.points[:, :2] <= high[:2] + 1e-6).all()
    assert "water surface" in shown.page


def test_without_refraction_there_is_no_surface(planted):
    run = planted.complete("run", "none")

    shown = of(read_contents(run, {}))

    assert shown.about["surfaces"] == []
    assert 'id="surface"' not in shown.page


def test_dense_points_take_the_place_of_sparse_ones_with_their_standard_deviations_and_stray_ones_are_left_out(planted):
    run = planted.complete("run")
    generator = torch.Generator().manual_seed(5)
    points = torch.rand(2000, 3, generator=generator, dtype=torch.float64) * 50.0
    points[7] = torch.tensor((1e5, 0.0, 0.0), dtype=torch.float64)
    sigma = torch.rand(2000, generator=generator, dtype=torch.float64)
    sigma[3] = torch.inf
    dense = cloud(points, sigma)
    write_dense(dense, run / "dense.ply")

    shown = of(read_contents(run, {}))

    stays = torch.arange(2000) != 7
    assert "1\u202f999 of 2\u202f000 dense points" in shown.page
    assert (shown.colors.reshape(-1, 3) == dense.colors[stays].numpy()).all()
    highest = next(scale for scale in shown.about["scales"] if scale["name"] == "sigma")["high"]
    expected = sigma[stays].clamp(max=highest).numpy()
    assert np.abs(shown.sigma / 255.0 * highest - expected).max() <= highest / 255.0
    assert highest == pytest.approx(0.995, abs=0.01)


def test_of_a_wall_y_is_up_and_depth_lies_behind_the_glass(planted):
    contents = read_contents(planted.complete("run"), {})
    interfaces = replace(contents.scene.interfaces, kinds=("wall",))

    shown = of(replace(contents, capture=None), interfaces=interfaces)

    x, y, z = (contents.scene.points - contents.scene.points.mean(dim=0)).numpy().T
    found = shown.points - shown.points.mean(axis=0)
    assert np.abs(found - np.stack((x, -z, y), axis=-1)).max() < 0.01
    scale = shown.about["scales"][0]
    depth = scale["sign"] * shown.points[:, scale["axis"]] + scale["middle"]
    assert np.abs(depth + contents.scene.points[:, 2].numpy()).max() < 0.01
    assert scale["label"] == "Depth behind the glass (cm)"


def test_a_page_of_many_points_stays_below_its_limit(planted):
    run = planted.complete("run")
    points = torch.rand(700_000, 3, generator=torch.Generator().manual_seed(6), dtype=torch.float64)
    write_dense(cloud(points, torch.ones(len(points), dtype=torch.float64)), run / "dense.ply")

    page = write_scene_page(read_contents(run, {}))

    assert 0.9 * MOST_BYTES < page.stat().st_size < MOST_BYTES


def test_it_asks_nothing_of_a_network(planted):
    run = planted.complete("run")

    page = of(read_contents(run, {})).page

    assert not re.search(r"https?:|url\(|@import|<link(?! rel=\"icon\" href=\"data:,\")|<iframe|\bsrc=", page)


def test_the_report_links_to_it_and_loads_nothing_of_it(planted):
    run = planted.complete("run")

    page = write_report(run).read_text()

    assert (run / "scene.html").is_file()
    assert page.count('href="scene.html"') == 1
    assert page.count("scene.html") == 2


def test_a_run_without_cameras_has_none_and_its_report_no_link(planted):
    run = planted.ended("failed", status="failed", reason="no images", model="none")

    page = write_report(run).read_text()

    assert not (run / "scene.html").exists()
    assert "scene.html" not in page
