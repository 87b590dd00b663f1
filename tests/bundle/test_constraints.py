"""Every kind of measurement and of unknown does in an adjustment what it is for."""

from dataclasses import replace

import pytest
import torch

from tests.bundle.changes import changed, tensor_of
from torchrefrac.bundle import CenterPrior, Expectations, GravityPrior, HeightPrior, KnownPoints, ScaleBars, Waterline
from torchrefrac.geometry import align_above_plane, heading_rotation, so3_exp

in_water_and_air = pytest.mark.parametrize("index_ratio", [1.333, 1.0], ids=["water", "air"])
ONE = torch.ones(1, dtype=torch.float64)


@pytest.fixture
def elsewhere(disturb):
    """`elsewhere(state)`: a little disturbed, and moved as images leave open: turned, shifted and a tenth larger."""

    def move(state):
        turn = heading_rotation(torch.tensor(0.2, dtype=torch.float64))
        shift = torch.tensor((4.0, -3.0, 0.0), dtype=torch.float64)
        state = disturb(state, size=0.1)
        return changed(
            state,
            rotation=state.views.rotation @ turn.T,
            center=1.1 * state.views.center @ turn.T + shift,
            points=1.1 * state.points @ turn.T + shift,
        )

    return move


def test_without_a_measurement_the_scene_stays_as_large_as_it_began(plant, elsewhere):
    planted = plant()

    report = planted.adjusted(elsewhere(planted.truth))

    assert _scale(report.scene, planted.truth) == pytest.approx(1.1, rel=0.01)


def test_a_scale_bar_fixes_the_scale(plant, elsewhere):
    planted = plant()
    first, second = torch.tensor([4]), torch.tensor([17])
    length = (planted.truth.points[4] - planted.truth.points[17]).norm()[None]

    report = planted.adjusted(elsewhere(planted.truth), terms=[ScaleBars(first, second, length, 0.1 * ONE)])

    assert report.costs[-1] < 1e-10
    assert _scale(report.scene, planted.truth) == pytest.approx(1.0, abs=1e-6)


def test_a_camera_height_fixes_the_scale(plant, elsewhere):
    planted = plant()
    height = planted.truth.views.center[2:3, 2]

    report = planted.adjusted(elsewhere(planted.truth), terms=[HeightPrior(torch.tensor([2]), height, 0.1 * ONE)])

    assert report.costs[-1] < 1e-10
    assert _scale(report.scene, planted.truth) == pytest.approx(1.0, abs=1e-6)


def test_two_measured_lengths_that_disagree_meet_where_their_standard_deviations_say(plant):
    """Twice the length with a third of the weight: at a quarter of the way."""
    planted = plant()
    both = torch.tensor((4, 4)), torch.tensor((17, 17))
    length = (planted.truth.points[4] - planted.truth.points[17]).norm()
    lengths = torch.stack((length, 1.04 * length))
    sigma = torch.tensor((1.0, 3.0**0.5), dtype=torch.float64)

    report = planted.adjusted(planted.truth, terms=[ScaleBars(*both, lengths, sigma)])

    assert _scale(report.scene, planted.truth) == pytest.approx(1.01, abs=1e-6)


@pytest.mark.parametrize("kind", ["points", "centres"])
def test_known_coordinates_fix_the_frame(plant, elsewhere, kind):
    planted = plant()
    index = torch.tensor((3, 1))
    information = 4.0 * torch.eye(3, dtype=torch.float64).expand(2, 3, 3)
    known = {
        "points": KnownPoints(index, planted.truth.points[index], information),
        "centres": CenterPrior(index, planted.truth.views.center[index], information),
    }[kind]

    report = planted.adjusted(elsewhere(planted.truth), terms=[known])

    _assert_same(report.scene, planted.truth, 1e-5)


def test_in_air_three_known_points_fix_the_frame(plant, elsewhere):
    planted = plant(index_ratio=1.0)
    index = torch.tensor((3, 1, 8))
    information = 4.0 * torch.eye(3, dtype=torch.float64).expand(3, 3, 3)
    start = elsewhere(planted.truth)
    tilt = so3_exp(torch.tensor((0.1, -0.05, 0.0), dtype=torch.float64))
    tilted = changed(
        start, rotation=start.views.rotation @ tilt.T, center=start.views.center @ tilt.T, points=start.points @ tilt.T
    )

    report = planted.adjusted(tilted, terms=[KnownPoints(index, planted.truth.points[index], information)])

    _assert_same(report.scene, planted.truth, 1e-5)


def test_points_on_the_shore_determine_how_high_the_water_stands_where_the_centres_are_known(plant, disturb):
    planted = _with_shore(plant(land=6, points=24), 6)
    start = changed(disturb(planted.truth, size=0.2), offset=planted.truth.interfaces.offset + 2.0)
    shore = Waterline(torch.arange(6), torch.zeros(6, dtype=torch.long), 0.1 * torch.ones(6, dtype=torch.float64))

    report = planted.adjusted(start, refine=("plane_height",), terms=[_all_centers(planted.truth), shore])

    assert report.costs[-1] < 1e-10
    assert float(report.scene.interfaces.offset[0]) == pytest.approx(0.0, abs=1e-5)
    _assert_same(report.scene, planted.truth, 1e-4)


def test_two_waters_find_their_heights_and_tilts(plant, disturb):
    planted = plant(views=6, interfaces=2)
    truth = planted.truth
    level = torch.tensor(((0.0, 0.0, 1.0),) * 2, dtype=torch.float64)
    start = changed(disturb(truth, size=0.2), normal=level, offset=torch.full_like(truth.interfaces.offset, 1.0))

    report = planted.adjusted(start, refine=("plane_tilt", "plane_height"), terms=[_all_centers(truth)])

    assert report.costs[-1] < 1e-10
    torch.testing.assert_close(report.scene.interfaces.normal, truth.interfaces.normal, rtol=0.0, atol=1e-6)
    torch.testing.assert_close(report.scene.interfaces.offset, truth.interfaces.offset, rtol=0.0, atol=1e-4)


def test_measured_gravity_and_a_height_stand_in_for_a_known_water(plant, disturb):
    """The water turns and rises with the scene; gravity levels the frame, the height gives the scale."""
    planted = plant()
    tilt = so3_exp(torch.tensor((0.03, -0.02, 0.0), dtype=torch.float64))
    start = disturb(planted.truth, size=0.2)
    start = changed(start, normal=start.interfaces.normal @ tilt.T, offset=start.interfaces.offset + 1.0)
    terms = [
        GravityPrior(planted.down_in_cam, 0.001),
        HeightPrior(torch.tensor([0]), planted.truth.views.center[:1, 2], 0.1 * ONE),
    ]

    report = planted.adjusted(start, refine=("plane_tilt", "plane_height"), terms=terms)

    state = report.scene
    assert report.costs[-1] < 1e-10
    torch.testing.assert_close(state.interfaces.normal, planted.truth.interfaces.normal, rtol=0.0, atol=1e-6)
    torch.testing.assert_close(-state.views.rotation[..., 2], planted.down_in_cam, rtol=0.0, atol=1e-6)
    above = state.views.center[:, 2] - state.interfaces.offset[0]
    torch.testing.assert_close(above, planted.truth.views.center[:, 2], rtol=0.0, atol=1e-4)


def test_two_cameras_find_their_focal_lengths(plant, disturb):
    planted = plant(views=6, points=60, cameras=2)
    factor = torch.tensor(((1.02,), (0.97,)), dtype=torch.float64)
    start = disturb(planted.truth, size=0.2)
    start = changed(start, focal=start.cameras.focal * factor)

    report = planted.adjusted(start, refine=("focal",))

    torch.testing.assert_close(report.scene.cameras.focal, planted.truth.cameras.focal, rtol=1e-6, atol=0.0)
    assert torch.equal(report.scene.cameras.distortion, planted.truth.cameras.distortion)


def test_a_camera_of_which_nothing_is_known_is_found_whole(plant, disturb):
    planted = plant(views=6, points=80, distortion=(-0.08, 0.02, 0.001, -0.002, 0.005))
    truth = planted.truth.cameras
    start = changed(
        disturb(planted.truth, size=0.1),
        focal=1.01 * truth.focal,
        principal_point=truth.principal_point + 4.0,
        distortion=torch.zeros_like(truth.distortion),
    )

    report = planted.adjusted(start, refine=("focal", "principal_point", "distortion"))

    found = report.scene.cameras
    torch.testing.assert_close(found.focal, truth.focal, rtol=0.0, atol=1e-3)
    torch.testing.assert_close(found.principal_point, truth.principal_point, rtol=0.0, atol=1e-3)
    torch.testing.assert_close(found.distortion, truth.distortion, rtol=0.0, atol=1e-5)


def test_a_free_index_ratio_is_found(plant, disturb):
    planted = plant(points=60, index_ratio=1.333)
    start = changed(disturb(planted.truth, size=0.2), index_ratio=torch.tensor(1.25, dtype=torch.float64))

    report = planted.adjusted(start, refine=("index_ratio",))

    assert report.costs[-1] < 1e-10
    assert float(report.scene.interfaces.index_ratio) == pytest.approx(1.333, abs=1e-7)


def test_what_is_expected_of_the_index_ratio_holds_it_as_its_standard_deviation_says(plant, disturb):
    planted = plant(index_ratio=1.333)
    start = changed(disturb(planted.truth, size=0.2), index_ratio=torch.tensor(1.32, dtype=torch.float64))

    sure, unsure = (
        planted.adjusted(
            start, refine=("index_ratio",), expected=Expectations(index_ratio=sigma)
        ).scene.interfaces.index_ratio
        for sigma in (1e-9, 1e3)
    )

    assert float(sure) == pytest.approx(1.32, abs=1e-6)
    assert float(unsure) == pytest.approx(1.333, abs=1e-6)


@in_water_and_air
@pytest.mark.parametrize("refine", [(), ("focal",)], ids=["intrinsics fixed", "focal"])
def test_fixed_views_stay_as_they_are_to_the_last_bit(plant, disturb, index_ratio, refine):
    planted = plant(noise=0.5, index_ratio=index_ratio)
    start = disturb(planted.truth, size=0.3)
    fixed = torch.zeros(4, 6, dtype=torch.bool)
    fixed[0], fixed[2] = True, True

    state = planted.adjusted(start, fixed=fixed, refine=refine).scene

    for before, after in ((start.views.rotation, state.views.rotation), (start.views.center, state.views.center)):
        assert torch.equal(after[[0, 2]], before[[0, 2]])
        assert (after[[1, 3]] != before[[1, 3]]).any(dim=-1).all()


@in_water_and_air
@pytest.mark.parametrize(("part", "name"), [(slice(0, 3), "rotation"), (slice(3, 6), "center")])
@pytest.mark.parametrize("views", [slice(0, 1), slice(None)], ids=["one view", "all views"])
def test_a_part_of_a_pose_is_fixed_to_the_last_bit(plant, disturb, index_ratio, part, name, views):
    planted = plant(noise=0.5, index_ratio=index_ratio)
    start = disturb(planted.truth, size=0.3)
    fixed = torch.zeros(4, 6, dtype=torch.bool)
    fixed[views, part] = True

    report = planted.adjusted(start, fixed=fixed)

    other = "center" if name == "rotation" else "rotation"
    assert torch.equal(tensor_of(report.scene, name)[views], tensor_of(start, name)[views])
    assert (tensor_of(report.scene, other)[views] != tensor_of(start, other)[views]).any()
    assert report.costs[-1] < report.costs[0]


def test_views_that_are_fixed_where_they_were_find_the_scene_in_their_frame(plant, disturb):
    planted = plant()
    start = disturb(planted.truth, size=0.3)
    fixed = torch.zeros(4, 6, dtype=torch.bool)
    fixed[:2] = True
    start.views.rotation[:2], start.views.center[:2] = planted.truth.views.rotation[:2], planted.truth.views.center[:2]

    report = planted.adjusted(start, fixed=fixed)

    _assert_same(report.scene, planted.truth, 1e-5)


def test_points_whose_coordinates_are_certain_go_there_whatever_the_pixels_say(plant):
    planted = plant()
    index = torch.tensor((3, 1, 8))
    off = torch.tensor(((0.5, 0.0, 0.0), (0.0, 0.0, 0.5), (0.0, 0.0, 0.0)), dtype=torch.float64)
    certain = 1e12 * torch.eye(3, dtype=torch.float64).expand(3, 3, 3)
    known = KnownPoints(index, planted.truth.points[index] + off, certain)

    report = planted.adjusted(planted.truth, terms=[known])

    torch.testing.assert_close(report.scene.points[index], known.position, rtol=0.0, atol=1e-6)
    assert report.costs[-1] > 1e-3


def test_with_the_refrax_ratio_frozen_the_cost_falls_but_not_to_the_minimum(plant, disturb):
    planted = plant()
    start = disturb(planted.truth, size=0.3)

    frozen, exact = (planted.adjusted(start, jacobian=name) for name in ("frozen_ratio", "exact"))

    assert frozen.costs[0] == exact.costs[0]
    assert frozen.costs[-1] < 0.1 * frozen.costs[0]
    assert exact.costs[-1] < 1e-6 * frozen.costs[-1]


def test_cauchys_loss_too_finds_the_scene_in_spite_of_a_few_wrong_observations(plant, disturb, draw):
    planted = plant(points=60)
    start = disturb(planted.truth, size=0.1)

    report = planted.with_wrong_observations(draw).adjusted(start, loss="cauchy", loss_scale=0.01)

    assert _center_error(report.scene, planted.truth) < 0.1


def test_from_nearby_a_truncated_loss_leaves_wrong_observations_no_say_at_all(plant, disturb, draw):
    planted = plant(points=60)
    wrong = planted.with_wrong_observations(draw)
    start = wrong.adjusted(disturb(planted.truth, size=0.1), loss="cauchy", loss_scale=0.1).scene

    report = wrong.adjusted(start, loss="truncated", loss_scale=1.0)

    assert _center_error(report.scene, planted.truth) < 1e-6


def _all_centers(truth):
    """Known to a millimetre."""
    count = len(truth.views.center)
    information = 100.0 * torch.eye(3, dtype=torch.float64).expand(count, 3, 3)
    return CenterPrior(torch.arange(count), truth.views.center, information)


def _with_shore(planted, count):
    """The first points put on the water."""
    points = planted.truth.points.clone()
    points[:count, 2] = 0.0
    seen = planted.observations
    pixels, valid = planted.truth.camera_of(seen.view).project(points[seen.point])
    assert valid.all()
    return replace(planted, truth=changed(planted.truth, points=points), observations=replace(seen, pixels=pixels))


def _scale(state, truth):
    """How much larger than the truth."""
    return float(1.0 / align_above_plane(state.views.center, truth.views.center).scale)


def _center_error(state, truth):
    return (
        (align_above_plane(state.views.center, truth.views.center).apply(state.views.center) - truth.views.center)
        .norm(dim=-1)
        .amax()
    )


def _assert_same(state, truth, tolerance):
    """Without any alignment."""
    for name in ("rotation", "center", "points"):
        torch.testing.assert_close(tensor_of(state, name), tensor_of(truth, name), rtol=0.0, atol=tolerance)
