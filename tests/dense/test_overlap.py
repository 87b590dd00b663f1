"""What a view cannot see is left out, and nothing else; views side by side end as one after the other."""

import pickle
from concurrent.futures import ThreadPoolExecutor
from dataclasses import fields, replace

import pytest
import torch

from tests.dense.planted_patches import patches_at
from tests.dense.rendered_captures import photographed_scene
from tests.dense.rendered_scenes import Board, cameras_around, marble, render
from torchrefrac.camera import Intrinsics, RefractiveCamera
from torchrefrac.dense import DenseOptions, densify
from torchrefrac.dense.filling import ViewJob, fill_view
from torchrefrac.dense.fusion import unobstructing
from torchrefrac.dense.images import Images
from torchrefrac.dense.neighbours import find_neighbours
from torchrefrac.dense.overlap import Finds, may_see
from torchrefrac.dense.patches import Patches
from torchrefrac.dense.rays import PixelRays
from torchrefrac.refraction import FlatInterface

OPTIONS = DenseOptions(method="patch", cell=5)
VIEWS, STEP = 12, 16.0
BED = -8.0


@pytest.fixture(scope="module")
def flight():
    """Twelve cameras in a line, 30 above the water and looking down, of which only the nearest few see the same."""
    center = torch.tensor([(STEP * i, 0.3 * i, 30.0) for i in range(VIEWS)], dtype=torch.float64)
    down = torch.diag(torch.tensor((1.0, -1.0, -1.0), dtype=torch.float64)).expand(VIEWS, 3, 3)
    return RefractiveCamera(Intrinsics.create(160, 120, 150.0), down, center, FlatInterface(1.33))


@pytest.fixture(scope="module")
def bed(flight):
    """A patch for every fourth pixel of every camera, on a bed with a step."""
    parts, up = [], torch.tensor((0.0, 0.0, 1.0), dtype=torch.float64)
    y, x = torch.meshgrid(torch.arange(2.0, 120.0, 4.0), torch.arange(2.0, 160.0, 4.0), indexing="ij")
    pixels = torch.stack((x, y), dim=-1).reshape(-1, 2).double()
    for view in range(VIEWS):
        rays = PixelRays.cast(flight[view], pixels)
        height = torch.where(pixels[:, :1] < 80.0 + 5.0 * view, BED, BED - 3.0) * up
        patches = patches_at(flight, view, pixels, rays.at(rays.meet(height, up)))
        seen = flight[:, None].project(patches.points, inside_image=True)[1].T.gather(1, patches.others)
        parts.append(replace(patches, visible=seen))
    return Patches.together(parts)


def test_a_view_may_see_all_that_falls_into_its_image_and_not_much_more(flight, bed):
    finds = Finds.of(bed, flight)

    for view in range(VIEWS):
        rows, some = finds.seen_by(view)

        _, shown = flight[view].project(bed.points, inside_image=True)
        assert shown[rows].sum() == shown.sum()
        assert torch.equal(some.points, bed.points[rows])
        assert (rows.diff() > 0).all()
        assert len(rows) < 0.75 * len(bed)
        assert len(rows) < 6.0 * shown.sum()


def test_of_a_long_flight_each_view_looks_at_few_others(flight, bed):
    sees = Finds.of(bed, flight).sees

    assert sees.diagonal().all()
    assert not sees[0, -3:].any()
    assert sees.sum(dim=1).max() <= 7


def test_a_box_around_the_camera_is_seen_and_one_behind_it_is_not(flight):
    center = flight.center_in_world[0]
    low = torch.stack((center - 5.0, center + center.new_tensor((-5.0, -5.0, 1.0)), center - 20.0))
    high = torch.stack((center + 5.0, center + 9.0, center + center.new_tensor((20.0, 20.0, -15.0))))

    assert may_see(flight[0], low, high).tolist() == [True, False, True]


def test_what_hides_something_is_found_as_if_every_view_looked_at_everything(flight, bed, monkeypatch):
    lid = bed[torch.arange(0, len(bed), 17)]
    lid = replace(lid, points=lid.points + torch.tensor((0.0, 0.0, 3.5)).double(), visible=lid.visible & False)
    patches = Patches.together([bed, lid])

    near = unobstructing(patches, flight, OPTIONS.cell)

    monkeypatch.setattr("torchrefrac.dense.overlap.WIDER", 1e9)
    assert torch.equal(near, unobstructing(patches, flight, OPTIONS.cell))
    assert 0 < (~near).sum() < len(lid) + 0.2 * len(bed)


def test_nothing_is_seen_of_nothing(flight):
    rows, patches = Finds.of(Patches.empty(2), flight).seen_by(3)

    assert len(rows) == len(patches) == 0


@pytest.fixture(scope="module")
def strip(tmp_path_factory):
    """The sparse scene and photographs of five cameras in a line over a painted bed."""
    around = cameras_around(5, 30.0, BED, 1.33)
    center = torch.tensor([(14.0 * i, 0.4 * i, 30.0) for i in range(5)], dtype=torch.float64)
    down = torch.diag(torch.tensor((1.0, -1.0, -1.0), dtype=torch.float64)).expand(5, 3, 3).contiguous()
    cameras = replace(around, cam_from_world_rotation=down, center_in_world=center)
    rendered = render([Board((0.0, 0.0, BED))], cameras, marble(), 1.33)
    return photographed_scene(rendered, tmp_path_factory.mktemp("strip"))


def _assert_same(first, second):
    for field in fields(Patches):
        assert torch.equal(getattr(first, field.name), getattr(second, field.name)), field.name


@pytest.mark.parametrize("method", ["patch", "depthmap"])
def test_several_views_at_a_time_end_as_one_after_the_other(strip, method):
    options = replace(OPTIONS, method=method)
    alone = densify(strip, options)

    with ThreadPoolExecutor(3) as executor:
        together = densify(strip, options, executor=executor)

    assert len(alone.patches) > 200
    assert not Finds.of(alone.patches, strip.camera_of()).sees.all()
    _assert_same(alone.patches, together.patches)
    assert torch.equal(alone.cloud.points, together.cloud.points)


def test_the_job_of_one_view_can_be_sent_to_another_process(strip):
    neighbourhoods = find_neighbours(strip, OPTIONS)
    images = Images(strip.capture)
    first = fill_view(ViewJob(neighbourhoods[0], images, OPTIONS, Patches.empty(OPTIONS.views)))
    job = ViewJob(neighbourhoods[1], images, OPTIONS, first)

    sent = pickle.loads(pickle.dumps(job))

    _assert_same(fill_view(sent), fill_view(job))
