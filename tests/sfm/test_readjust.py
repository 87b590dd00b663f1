"""Adjusting a whole scene: from poses of a pinhole to those of the truth, and what is refused."""

from dataclasses import dataclass, replace

import pytest
import torch

from tests.planted_reconstructions import plant_reconstruction
from torchrefrac.bundle import BundleOptions, UnadjustableError
from torchrefrac.evaluate.survey_consistency import survey_contradictions
from torchrefrac.recorder import SilentRecorder
from torchrefrac.scene import Scene, Survey, SurveyError
from torchrefrac.scene.survey import ControlPoint, ScaleBar, SurveyedImage, resolve
from torchrefrac.sfm import Outcome, ReadjustOptions, readjust, with_found_level
from torchrefrac.sfm.water_level import candidate_offsets

SMALL = (1e4 * torch.eye(3, dtype=torch.float64)).tolist()  # information of a position known to 0.01


class Notes(SilentRecorder):
    """Keeps the lines that a person should see."""

    def __init__(self):
        self.lines = []

    def note(self, text):
        self.lines.append(text)


@pytest.fixture
def plant(make_basin, draw):
    """`plant(noise=0.0, intrinsics=1, interfaces=1, ...)`: six cameras and 80 points; the rest goes to `make_basin`."""

    def make(noise=0.0, intrinsics=1, interfaces=1, **scene):
        basin = make_basin(**{"cameras": 6, "points": 80, "seen_by": 3} | scene)
        return plant_reconstruction(basin, draw, noise, intrinsics, interfaces)

    return make


@dataclass(frozen=True)
class Found:
    """scene: all views and points, then the ground control points. outcome: of the last adjustment."""

    given: Scene
    survey: Survey
    scene: Scene
    outcome: Outcome

    @property
    def ties(self) -> Scene:
        """The views and points that stayed, without ground control."""
        of_ties = self.scene.observations.point < len(self.given.points)
        scene = replace(self.scene, accepted=self.scene.accepted & of_ties)
        return scene.of_views(scene.views.registered).trimmed()

    @property
    def control(self) -> dict[str, list[float]]:
        """Positions of the ground control points that fit, by name."""
        count, scene = len(self.given.points), self.scene
        placed, points = scene.placed[count:].tolist(), scene.points[count:].tolist()
        return {name: at for name, there, at in zip(self.survey.control_names, placed, points, strict=True) if there}

    @property
    def lost_control(self) -> tuple[str, ...]:
        return tuple(name for name in self.survey.control_names if name not in self.control)

    @property
    def lost_views(self) -> tuple[str, ...]:
        names, there = self.scene.views.names, self.scene.views.registered.tolist()
        return tuple(name for name, here in zip(names, there, strict=True) if not here)


def adjust(given, survey=None, options=None, recorder=None) -> Found:
    return Found(given, survey or Survey.empty(given.views.names), *readjust(given, survey, options, recorder))


def at_offset(scene, offset):
    """With its one surface at another height."""
    return replace(scene, interfaces=replace(scene.interfaces, offset=torch.tensor([offset], dtype=torch.float64)))


def with_pixels(scene, pixels):
    return replace(scene, observations=replace(scene.observations, pixels=pixels))


def options(*refine, **changes):
    """That converge as far as float64 goes."""
    bundle = BundleOptions(loss_scale=1.0, pixel_sigma=0.5, refine=refine)
    solver = replace(bundle.solver, max_iterations=200, function_tolerance=1e-13)
    return ReadjustOptions(bundle=replace(bundle, solver=solver), **changes)


@pytest.mark.parametrize("scene", [{}, {"intrinsics": 2}, {"interfaces": 2}, {"land": 20}])
def test_cameras_of_a_pinhole_come_to_the_truth(plant, draw, scene):
    planted = plant(**scene)
    given = planted.as_of_a_pinhole(draw)
    if "interfaces" in scene:  # two planes fix more of the frame: only where cameras stand along their line is free
        truth = planted.truth.views.center
        given = replace(given, views=given.views.at(given.views.rotation, truth + 0.2 * (given.views.center - truth)))

    found = adjust(given, options=options())

    assert found.outcome.numbers["median_before"] > 1.0
    assert found.outcome.numbers["not_triangulated"] == 0
    assert float(found.ties.errors().max()) < 1e-4
    if "interfaces" not in scene:
        assert float(planted.off(found.scene).max()) < 1e-3
    assert found.ties.views.names == given.views.names
    assert torch.equal(found.scene.views.camera, given.views.camera)
    assert found.scene.cameras.sizes == given.cameras.sizes
    assert torch.equal(found.scene.cameras.focal, given.cameras.focal)


def test_points_and_colours_stay_together(plant, draw):
    planted = plant()

    found = adjust(planted.as_of_a_pinhole(draw, 0.0), options=options()).ties

    assert torch.equal(found.colors, planted.truth.colors)
    torch.testing.assert_close(found.points, planted.truth.points, rtol=0.0, atol=1e-5)
    assert torch.equal(found.observations.pixels, planted.truth.observations.pixels)


def test_a_frame_that_nothing_fixes_stays_where_it_is(plant, draw):
    given = plant().as_of_a_pinhole(draw, 0.0)

    found = adjust(given, options=options())

    assert float((found.scene.views.center - given.views.center).norm(dim=-1).max()) < 1e-5


def test_the_index_ratio_is_found_from_a_wrong_one(plant, draw):
    planted = plant()
    given = planted.as_of_a_pinhole(draw)
    ratio = torch.full_like(given.interfaces.index_ratio, 1.25)
    given = replace(given, interfaces=replace(given.interfaces, index_ratio=ratio))

    found = adjust(given, options=options("index_ratio"))

    assert found.scene.index_ratio == pytest.approx(1.33, abs=1e-5)
    assert float(planted.off(found.scene).max()) < 1e-3
    assessment = found.scene.assessment
    assert assessment.index_ratio_sigma is not None
    assert any(line.startswith("index ratio: determined to") for line in assessment.determined)


def test_both_focal_lengths_are_found_from_wrong_ones(plant, draw):
    planted = plant(intrinsics=2, points=200)
    given = planted.as_of_a_pinhole(draw, 0.2)
    given = replace(given, cameras=replace(given.cameras, focal=given.cameras.focal * 1.02))

    found = adjust(given, options=options("focal"))

    torch.testing.assert_close(found.scene.cameras.focal, planted.truth.cameras.focal, rtol=1e-5, atol=0.0)


def test_wrong_observations_are_dropped_and_no_others(plant, draw):
    planted = plant(noise=0.2, points=150, cameras=8, seen_by=6)
    right = planted.truth.observations.pixels
    wrong = torch.zeros(len(right), dtype=torch.bool)
    wrong[::15] = True
    pixels = right + 40.0 * wrong[:, None] * draw.directions(len(wrong))[:, :2].sign()

    found = adjust(with_pixels(planted.as_of_a_pinhole(draw), pixels), options=options())

    assert torch.equal(found.scene.accepted, ~wrong)
    assert float(planted.off(found.scene).max()) < 0.1


def test_a_view_that_does_not_fit_is_left_out_and_named(plant, draw):
    planted = plant(noise=0.2, points=150)
    off = planted.truth.observations.view == 4
    nonsense = draw.uniform(0.0, 768.0, len(off), 2)
    pixels = torch.where(off[:, None], nonsense, planted.truth.observations.pixels)

    found = adjust(with_pixels(planted.as_of_a_pinhole(draw), pixels), options=options())

    assert found.lost_views == ("cam04.jpg",)
    assert found.ties.views.names == tuple(name for name in planted.truth.views.names if name != "cam04.jpg")
    assert found.scene.views.registered.nonzero()[:, 0].tolist() == [0, 1, 2, 3, 5]
    assert float(planted.off(found.scene).max()) < 0.2


def test_fixed_cameras_stay_to_the_last_bit(plant, draw):
    planted = plant()
    given = at_offset(planted.as_of_a_pinhole(draw, 0.0), 3.0)

    found = adjust(given, options=options("plane_height", held="cameras"))

    assert torch.equal(found.scene.views.center, given.views.center)
    assert torch.equal(found.scene.views.rotation, given.views.rotation)
    assert float(found.scene.interfaces.offset) == pytest.approx(0.0, abs=1e-4)
    torch.testing.assert_close(found.ties.points, planted.truth.points, rtol=0.0, atol=1e-3)


def test_measured_heights_fix_the_scale(plant, draw):
    planted = plant()
    given, truth = planted.as_of_a_pinhole(draw), planted.truth.views
    given = replace(
        given, views=given.views.at(given.views.rotation, 0.4 * given.views.center), points=0.4 * given.points
    )
    heights = {
        name: SurveyedImage(height=(float(c[2]), 0.1)) for name, c in zip(truth.names, truth.center, strict=True)
    }

    found = adjust(given, resolve(heights, {}, [], truth.names), options())

    torch.testing.assert_close(found.scene.views.center[:, 2], truth.center[:, 2], rtol=0.0, atol=1e-3)


def _control(planted, point, **known):
    """A ground control point at a point of the truth, seen where this is."""
    seen = planted.truth.observations[planted.truth.observations.point == point]
    names = [planted.truth.views.names[i] for i in seen.view.tolist()]
    return ControlPoint(dict(zip(names, seen.pixels.tolist(), strict=True)), **known)


def test_known_control_fixes_the_whole_frame(plant, draw):
    planted = plant(noise=0.05)
    known = {f"m{i}": _control(planted, i, known=(planted.truth.points[i].tolist(), SMALL)) for i in range(4)}
    given = planted.as_of_a_pinhole(draw)

    found = adjust(given, resolve({}, known, [], given.views.names), options())

    torch.testing.assert_close(found.scene.views.center, planted.truth.views.center, rtol=0.0, atol=0.05)
    assert found.control["m2"] == pytest.approx(planted.truth.points[2].tolist(), abs=0.03)
    assert len(found.ties.points) == len(planted.truth.points)
    assert len(found.scene.assessment.point_sigma) == len(found.scene.points)
    assert found.scene.assessment.point_sigma.isfinite().equal(found.scene.placed)


def test_a_control_point_that_one_view_sees_goes_by_its_known_position(plant, draw):
    planted = plant()
    point = _control(planted, 0, known=(planted.truth.points[0].tolist(), SMALL))
    once = replace(point, pixels=dict(list(point.pixels.items())[:1]))
    given = planted.as_of_a_pinhole(draw)

    found = adjust(given, resolve({}, {"once": once}, [], given.views.names), options())

    assert found.lost_control == ()
    assert found.control["once"] == pytest.approx(planted.truth.points[0].tolist(), abs=1e-2)
    assert float(planted.off(found.scene).max()) < 1e-2


def test_a_scale_bar_fixes_the_scale(plant, draw):
    planted = plant()
    length = float((planted.truth.points[0] - planted.truth.points[1]).norm())
    ends, bar = {"a": _control(planted, 0), "b": _control(planted, 1)}, ScaleBar("a", "b", 2.0 * length, 0.01)
    given = planted.as_of_a_pinhole(draw)

    found = adjust(given, resolve({}, ends, [bar], given.views.names), options())

    truth = planted.truth.views.center
    torch.testing.assert_close(found.scene.views.center[:, 2], 2.0 * truth[:, 2], rtol=0.0, atol=1e-2)


def test_a_control_point_on_the_waterline_fixes_the_height_of_the_plane(plant, draw):
    planted = plant(land=20)
    point = int((planted.truth.points[:, 2].abs()).argmin())
    level = float(planted.truth.points[point, 2])
    edge = replace(_control(planted, point), waterline=0.001)
    given = planted.as_of_a_pinhole(draw, 0.0)

    survey = resolve({}, {"edge": edge}, [], given.views.names)
    found = adjust(given, survey, options("plane_height", held="cameras"))

    height = float(found.control["edge"][2] - found.scene.interfaces.offset)
    assert abs(height) < abs(level)


def test_a_control_point_that_does_not_fit_is_named(plant, draw):
    planted = plant()
    point = _control(planted, 0)
    pixels = {name: [x + 60.0 * (-1) ** i, y + 50.0] for i, (name, (x, y)) in enumerate(point.pixels.items())}
    given = planted.as_of_a_pinhole(draw)

    survey = resolve({}, {"bad": replace(point, pixels=pixels)}, [], given.views.names)
    found = adjust(given, survey, options())

    assert found.lost_control == ("bad",)
    assert float(planted.off(found.scene).max()) < 1e-2


def _warnings(found):
    return survey_contradictions(found.scene, found.survey, found.outcome.survey)


def _measured_centers(planted, wrong):
    """All centres to 0.05, those of `wrong` shifted."""
    information = (400.0 * torch.eye(3, dtype=torch.float64)).tolist()
    centers = planted.truth.views.center.clone()
    for image, shift in wrong.items():
        centers[image] += torch.tensor(shift, dtype=torch.float64)
    names = planted.truth.views.names
    return {name: SurveyedImage(center=(at, information)) for name, at in zip(names, centers.tolist(), strict=True)}


@pytest.mark.parametrize("wrong", [{}, {2: (5.0, -3.0, 1.0)}, {5: (0.0, 0.0, 0.5)}])
def test_a_position_that_all_others_contradict_is_named_and_not_used(plant, draw, wrong):
    planted = plant(noise=0.05)
    given = planted.as_of_a_pinhole(draw)
    survey = resolve(_measured_centers(planted, wrong), {}, [], given.views.names)

    found = adjust(given, survey, options())

    findings = _warnings(found)
    names = [tuple(given.views.names[image] for image in wrong)] if wrong else []
    assert [finding.images for finding in findings] == names
    assert {str(finding.code) for finding in findings} <= {"position_contradicts"}
    assert all("contradict was not used" in finding.message for finding in findings)
    torch.testing.assert_close(found.scene.views.center, planted.truth.views.center, rtol=0.0, atol=0.1)


def test_where_most_positions_are_wrong_all_are_named_and_used(plant, draw):
    planted = plant(noise=0.05)
    given = planted.as_of_a_pinhole(draw)
    wrong = {image: (3.0 * (-1) ** image, 2.0 * (image % 3), 1.0) for image in range(6)}
    survey = resolve(_measured_centers(planted, wrong), {}, [], given.views.names)

    (finding,) = _warnings(adjust(given, survey, options()))

    assert finding.code == "position_contradicts"
    assert len(finding.images) > 3
    assert "was used" in finding.message


@pytest.mark.parametrize("shift", [0.2, 20.0])
def test_ground_control_that_the_rest_contradicts_is_named_and_not_used(plant, draw, shift):
    planted = plant(noise=0.05)
    at = planted.truth.points[:5].clone()
    at[3, 0] += shift
    known = {f"m{i}": _control(planted, i, known=(at[i].tolist(), SMALL)) for i in range(5)}
    given = planted.as_of_a_pinhole(draw)
    survey = resolve({}, known, [], given.views.names)

    found = adjust(given, survey, options())

    (finding,) = _warnings(found)
    assert finding.code == "control_contradicts"
    assert "m3: " in finding.message
    torch.testing.assert_close(found.scene.views.center, planted.truth.views.center, rtol=0.0, atol=0.1)


def test_an_adjustment_that_stops_early_says_so(plant, draw):
    planted = plant(noise=0.05)
    given = planted.as_of_a_pinhole(draw)
    bundle = replace(options().bundle, solver=replace(options().bundle.solver, max_iterations=1))

    found = adjust(given, None, replace(options(), bundle=bundle))

    codes = [str(finding.code) for finding in _warnings(found)]
    assert codes[-1] == "not_converged"
    assert found.scene.assessment.stopped_after == 1


def test_the_water_level_is_found_between_points_and_cameras(plant, draw):
    planted = plant(points=120)
    given = planted.as_of_a_pinhole(draw)
    up = given.points.new_tensor((0.0, 0.0, 500.0))
    raised = replace(
        given, views=given.views.at(given.views.rotation, given.views.center + up), points=given.points + up
    )

    levelled = with_found_level(raised, options=options())
    found = adjust(levelled, options=options("plane_height")).scene

    assert 400.0 < float(levelled.interfaces.offset) < 530.0
    assert levelled.views is raised.views
    assert levelled.points is raised.points
    above = found.views.center - found.interfaces.offset * found.interfaces.normal
    assert float(planted.off(replace(found, views=found.views.at(found.views.rotation, above))).max()) < 1e-2


def test_candidates_for_the_water_level_lie_below_all_cameras(plant, draw):
    given = plant().as_of_a_pinhole(draw)

    offsets = candidate_offsets(given)

    assert bool((offsets < given.views.center[:, 2].min()).all())
    assert bool((offsets.diff() > 0).all())
    downwards = replace(given, interfaces=replace(given.interfaces, normal=-given.interfaces.normal))
    with pytest.raises(UnadjustableError, match="the cameras are not above the points along the normal"):
        candidate_offsets(downwards)


def test_a_plane_below_the_points_is_remarked_upon(plant, draw):
    notes = Notes()

    adjust(at_offset(plant().as_of_a_pinhole(draw), -500.0), options=ReadjustOptions(rounds=1), recorder=notes)

    assert notes.lines[0].startswith("80 of 80 points lie above the water, where nothing refracts")


def test_points_that_cannot_be_triangulated_are_counted_and_left_out(plant, draw):
    given = plant().as_of_a_pinhole(draw, 0.0)
    pixels = given.observations.pixels.clone()
    rows = (given.observations.point == 7).nonzero()[:, 0]
    pixels[rows] = pixels.new_tensor((512.0, 384.0)) + 300.0 * draw.normal(len(rows), 2)

    found = adjust(with_pixels(given, pixels), options=options()).ties

    assert len(found.points) == len(given.points) - 1
    assert torch.equal(found.colors, torch.cat((given.colors[:7], given.colors[8:])))


@pytest.mark.parametrize(
    ("spoil", "sentence"),
    [
        (lambda s: s.of_views(torch.arange(len(s.views)) == 0), "the reconstruction has 1 image"),
        (
            lambda s: with_pixels(s, s.observations.pixels.index_fill(0, torch.tensor([3]), torch.nan)),
            "pixels are not finite",
        ),
        (
            lambda s: replace(
                s, views=s.views.at(s.views.rotation, s.views.center.index_fill(0, torch.tensor([2]), -1.0))
            ),
            "not above the water plane: cam02.jpg",
        ),
        (
            lambda s: replace(s, views=s.views.at(s.views.rotation * torch.nan, s.views.center)),
            "rotation is not finite",
        ),
    ],
)
def test_what_cannot_be_adjusted_is_refused_with_the_names_of_images(plant, spoil, sentence):
    planted = plant()

    with pytest.raises(UnadjustableError, match=sentence):
        readjust(spoil(planted.truth))


def in_two_parts(truth):
    """No point is seen by views of both parts, the last two of which have moved."""
    seen, apart = truth.observations, truth.observations.view < 4
    wanted = torch.where(seen.point % 2 == 0, apart, ~apart)
    split = replace(truth, observations=seen[wanted], accepted=truth.accepted[wanted]).cleaned()
    center = split.views.center + torch.tensor((0.5, -0.3, 0.0)) * (torch.arange(6)[:, None] >= 4)
    return replace(split, views=split.views.at(split.views.rotation, center))


def test_views_that_nothing_connects_are_named(plant):
    with pytest.raises(UnadjustableError, match=r"no common points connect the images: 2 parts.*cam04.jpg, cam05.jpg"):
        readjust(in_two_parts(plant().truth))


def test_views_that_positions_alone_connect_are_adjusted(plant):
    truth = plant().truth
    centers = truth.views.center.tolist()
    images = {name: SurveyedImage(center=(at, SMALL)) for name, at in zip(truth.views.names, centers, strict=True)}

    scene, _ = readjust(in_two_parts(truth), resolve(images, {}, [], truth.views.names))

    assert scene.views.registered.all()
    torch.testing.assert_close(scene.views.center, truth.views.center, rtol=0.0, atol=1e-3)


def test_measured_gravity_wants_a_frame_whose_z_points_up(plant):
    truth = plant().truth
    down = {
        name: SurveyedImage(down=((-rotation[:, 2]).tolist(), 0.01))
        for name, rotation in zip(truth.views.names, truth.views.rotation, strict=True)
    }
    turn = torch.tensor(((1.0, 0.0, 0.0), (0.0, 0.0, -1.0), (0.0, 1.0, 0.0)), dtype=torch.float64)
    turned = replace(
        truth,
        views=truth.views.at(truth.views.rotation @ turn.T, truth.views.center @ turn.T),
        interfaces=replace(truth.interfaces, normal=turn[:, 2][None]),
    )

    with pytest.raises(SurveyError, match="disagree by 90 degrees"):
        readjust(turned, resolve(down, {}, [], turned.views.names))
    readjust(turned, Survey.empty(turned.views.names))


def test_options_that_cannot_work_are_refused():
    with pytest.raises(ValueError, match="rounds is 0, but must be finite and at least 1"):
        ReadjustOptions(rounds=0)
    with pytest.raises(ValueError, match="max_error is -1"):
        ReadjustOptions(max_error=-1.0)


def test_of_an_uncertain_rational_distortion_five_coefficients_are_found_and_three_stay_as_stated(plant):
    truth = plant(noise=0.3, cameras=5, points=50, distortion=(-0.05, 0.01, 0.0, 0.0, 0.0, 0.02, -0.01, 0.002)).truth
    sigma = torch.full_like(truth.cameras.distortion_sigma, 0.01)
    off = truth.cameras.distortion.new_tensor((0.005, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0))
    stated = replace(truth.cameras, distortion=truth.cameras.distortion + off, distortion_sigma=sigma)

    scene, outcome = readjust(replace(truth, cameras=stated), Survey.empty(truth.views.names))

    assert outcome.done
    found = scene.cameras.distortion[0]
    assert float((found[0] - truth.cameras.distortion[0, 0]).abs()) < 0.004
    assert torch.equal(found[5:], stated.distortion[0, 5:])
    known = scene.assessment
    assert known.fixed == {"k4_to_k6": "k4 to k6: as stated, for nothing tells them from k1 to k3"}
    assert known.determined[0].startswith("distortion: determined to 0.00")


def test_a_tilt_of_the_water_that_is_hardly_known_is_named(plant):
    truth = plant().truth
    survey = Survey.empty(truth.views.names)

    for sigma, codes in ((0.002, []), (0.05, ["gravity_undetermined"])):
        scene = replace(truth, assessment=replace(truth.assessment, tilt_sigma=sigma))
        assert [found.code for found in survey_contradictions(scene, survey, survey)] == codes
