"""What photographs show of the ground by their stated positions, against rays that are followed one by one."""

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from torchrefrac.camera import Intrinsics
from torchrefrac.geometry import heading_rotation, level_rotation, so3_exp
from torchrefrac.scene import Cameras, Capture, Georeference, Interfaces
from torchrefrac.sfm.footprints import FARTHEST, NO_OVERLAP, Footprints, position_scores

HEIGHT, WIDTH, TALL, FOCAL = 10.0, 400, 200, 200.0  # which shows 20 by 10 from straight above


@pytest.fixture
def flight():
    """`flight(x and y of each camera, down, heading, sigma)`: photographs from HEIGHT above the water; all straight
    down, with their tops to the north and exact positions, unless it says otherwise."""

    def make(places, down=(0.0, 0.0, 1.0), heading=0.0, sigma=1e-9):
        count = len(places)
        position = torch.tensor([(*place, HEIGHT) for place in places], dtype=torch.float64)
        intrinsics = Intrinsics.create(
            width=WIDTH, height=TALL, focal=(FOCAL, FOCAL), principal_point=(WIDTH / 2, TALL / 2), distortion=(0.0,) * 5
        )
        return Capture(
            folder=Path("nowhere"),
            names=tuple(f"{i}.jpg" for i in range(count)),
            paths=tuple(Path(f"{i}.jpg") for i in range(count)),
            cameras=Cameras.of([intrinsics]),
            interfaces=Interfaces.level(1.33),
            down_in_cam=torch.tensor(down, dtype=torch.float64).expand(count, 3),
            down_sigma=torch.full((count,), 1e-9, dtype=torch.float64),
            height=torch.zeros(count, dtype=torch.float64),
            has_height=torch.zeros(count, dtype=torch.bool),
            length_unit="m",
            position=position,
            position_sigma=torch.full_like(position, sigma),
            heading=torch.full((count,), heading, dtype=torch.float64),
            has_heading=torch.ones(count, dtype=torch.bool),
        )

    return make


def _of(capture):
    return Footprints.of(capture, torch.full((len(capture),), HEIGHT).double(), torch.arange(len(capture)))


RECTANGLES = {
    (0.0, 0.0): 1.0, (9.9, 0.0): 4 / 7, (0.0, 4.9): 4 / 7, (9.9, 4.9): 16 / 49, (20.1, 0.0): 0.0, (0.0, 10.1): 0.0,
}  # fmt: skip


@pytest.mark.parametrize(("place", "share"), RECTANGLES.items())
def test_photographs_straight_down_share_the_common_part_of_two_rectangles(flight, place, share):
    """Of 7 x 7 points of each, which reach from border to border."""
    overlap = _of(flight([(0.0, 0.0), place])).overlap()

    assert float(overlap[0, 1]) == pytest.approx(share)
    assert torch.equal(overlap, overlap.T)


def test_a_heading_turns_what_is_shown(flight):
    east = math.radians(90.0)

    assert float(_of(flight([(0.0, 0.0), (0.0, 15.0)], heading=east)).overlap()[0, 1]) > 0.2
    assert float(_of(flight([(0.0, 0.0), (15.0, 0.0)], heading=east)).overlap()[0, 1]) == 0.0


def test_points_and_axes_are_where_rays_of_the_camera_meet_the_ground(flight):
    tilt = so3_exp(torch.tensor([0.3, -0.2, 0.0], dtype=torch.float64))
    down, heading = tilt @ torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64), 0.7
    capture = flight([(3.0, -2.0)], down.tolist(), heading)

    found = _of(capture)

    world_from_cam = (level_rotation(down) @ heading_rotation(torch.tensor(heading).double())).T
    expected = []
    for x in torch.linspace(0.0, WIDTH, 7, dtype=torch.float64).tolist():
        for y in torch.linspace(0.0, TALL, 7, dtype=torch.float64).tolist():
            ray = world_from_cam @ torch.tensor([(x - WIDTH / 2) / FOCAL, (y - TALL / 2) / FOCAL, 1.0]).double()
            expected.append(capture.position[0] - HEIGHT / ray[2] * ray)
    expected = torch.stack(expected)
    torch.testing.assert_close(expected[:, 2], torch.zeros(49).double(), rtol=0.0, atol=1e-12)
    torch.testing.assert_close(found.points[0], expected[:, :2])
    torch.testing.assert_close(found.axis[0], world_from_cam[:, 2])
    torch.testing.assert_close(found.farthest[0, 0], expected[:, 0].max())
    torch.testing.assert_close(found.farthest[0, 4], expected[:, 1].max())


def test_a_camera_that_sees_the_horizon_sees_no_farther_than_the_ground_can_be_recognised(flight):
    level = flight([(0.0, 0.0)], down=(0.0, 1.0, 0.0))  # its optical axis to the north

    found = _of(level)

    assert float(found.points.norm(dim=-1).max()) == pytest.approx(FARTHEST * HEIGHT)
    assert float(found.points[..., 1].min()) > 0.0


def test_without_a_heading_it_counts_how_far_a_photograph_may_reach(flight):
    capture = flight([(0.0, 0.0), (0.0, 15.0), (15.0, 0.0), (30.0, 0.0)])
    unknown = replace(capture, has_heading=torch.zeros_like(capture.has_heading))

    overlap = _of(unknown).overlap()

    assert float(overlap[0, 1]) > 0.0
    assert float(overlap[0, 2]) > 0.0
    assert float(overlap[0, 3]) == 0.0  # two discs of radius 11.2


def test_what_is_uncertain_makes_an_overlap_possible_that_counts_less_than_a_stated_one(flight):
    places = [(0.0, 0.0), (18.0, 0.0), (30.0, 0.0), (90.0, 0.0)]

    score = position_scores(flight(places, sigma=3.0))

    assert float(score[0, 1]) > float(score[0, 2]) > 0.0 > NO_OVERLAP > float(score[0, 3])


def test_opposite_views_of_one_place_count_less_than_views_from_one_side(flight):
    tilt = math.radians(40.0)
    slanted = flight([(0.0, -8.0), (3.0, -8.0), (0.0, 8.0)], down=(0.0, math.sin(tilt), math.cos(tilt)))
    facing = replace(slanted, heading=torch.tensor([0.0, 0.0, math.pi]).double())

    score = position_scores(facing)

    assert float(score[0, 1]) > 2.0 * float(score[0, 2]) > 0.0


def test_heights_are_those_above_the_level_that_stated_heights_say(flight):
    capture = flight([(0.0, 0.0), (10.0, 0.0), (18.0, 0.0)])
    raised = replace(
        capture,
        position=capture.position + torch.tensor([0.0, 0.0, 431.0]).double(),
        georeference=Georeference("EPSG:32633", (0.0, 0.0, 0.0)),
        height=torch.tensor([HEIGHT, 0.0, 0.0]).double(),
        has_height=torch.tensor([True, False, False]),
    )

    torch.testing.assert_close(position_scores(raised), position_scores(capture))


def test_without_gravity_or_height_the_nearest_cameras_are_the_best(flight):
    capture = flight([(0.0, 0.0), (4.0, 0.0), (9.0, 0.0), (40.0, 0.0)])
    on_a_map = replace(capture, georeference=Georeference("EPSG:32633", (0.0, 0.0, 0.0)))
    for blind in (replace(capture, down_sigma=torch.full((4,), torch.inf).double()), on_a_map):
        score = position_scores(blind)

        torch.testing.assert_close(score[0, 1:], -torch.tensor([0.1, 0.225, 1.0]).double())


def test_what_has_no_position_has_no_score(flight):
    capture = flight([(0.0, 0.0), (4.0, 0.0), (9.0, 0.0)])
    capture.position_sigma[1] = torch.inf

    score = position_scores(capture)

    assert score[1].isinf().all()
    assert float(score[0, 2]) > 0.0
    capture.position_sigma[:] = torch.inf
    assert position_scores(capture).isinf().all()
