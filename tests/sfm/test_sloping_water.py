"""A river that falls along its reach: two gauges at its ends, which level water would contradict."""

from dataclasses import dataclass, replace

import pytest
import torch
from torch import Tensor

from tests.conftest import Basin
from tests.sfm.conftest import Survey as Photographed
from tests.sfm.test_survey_frame import contradicted, reconstruct_with
from torchrefrac.bundle import uncertainty
from torchrefrac.bundle.layout import Layout
from torchrefrac.camera import Intrinsics
from torchrefrac.evaluate.metrics import summarize
from torchrefrac.evaluate.survey_consistency import survey_contradictions
from torchrefrac.evaluate.water_levels import slope_metrics
from torchrefrac.geometry import Rigid, Similarity, heading_rotation, level_rotation, levelling, rotate
from torchrefrac.scene import Cameras, Capture, Interfaces, Observations, Scene, Survey
from torchrefrac.scene.survey import SurveyedImage, WaterMark, resolve
from torchrefrac.sfm import readjust
from torchrefrac.sfm.control import survey_terms
from torchrefrac.sfm.frame import moved, transformed
from torchrefrac.sfm.stated_levels import StatedLevels

HEIGHT = 420.0  # of the water at the origin, m
SLOPE = torch.tensor((0.0018, -0.0009)).double()
REACH, WIDTH, FLIGHT = 36.0, 10.0, 12.0  # m
POSITION, GAUGE = (0.01, 0.01, 0.01), 0.01  # m
NOISE, GRAVITY = 0.2, 0.005  # px, radians


@dataclass(frozen=True)
class River:
    """photographed: what images show, in the frame of the water; along: the unit vector to the higher gauge."""

    photographed: Photographed
    along: Tensor
    level_from_water: Tensor

    def in_survey(self, points: Tensor) -> Tensor:
        """Points of the water's frame in that of the survey, which is level."""
        return rotate(self.level_from_water, points) + torch.tensor((0.0, 0.0, HEIGHT)).double()

    def stated(self, *marks: WaterMark) -> Survey:
        """Positions and verticals of the photographs, and levels."""
        capture = self.photographed.capture
        information = torch.diag_embed(capture.position_sigma.square().reciprocal()).tolist()
        positions = zip(capture.position.tolist(), information, strict=True)
        down = zip(capture.down_in_cam.tolist(), capture.down_sigma.tolist(), strict=True)
        images = [SurveyedImage(down=of, center=at) for of, at in zip(down, positions, strict=True)]
        return resolve(dict(zip(capture.names, images, strict=True)), {}, [], capture.names, marks)

    def by_level_water(self) -> Scene:
        """The true scene in the frame of the survey, under water that is level."""
        one, up = torch.ones(()).double(), torch.tensor((0.0, 0.0, HEIGHT)).double()
        scene = transformed(self.photographed.scene(with_points=True), Similarity(one, self.level_from_water, up))
        return replace(scene, interfaces=Interfaces.level(1.33, HEIGHT + 0.05))

    def gauges(self, *off: float) -> list[WaterMark]:
        """At both ends, off by so much."""
        ends = torch.tensor((-0.5, 0.5)).double()[:, None] * REACH * self.along
        at = self.in_survey(torch.cat((ends, torch.zeros(2, 1).double()), dim=1))
        return [
            WaterMark(f"gauge {name}", (x, y, z + by), GAUGE)
            for name, (x, y, z), by in zip(("low", "high"), at.tolist(), off, strict=True)
        ]


@pytest.fixture
def river(draw, tmp_path) -> River:
    """Two strips of six photographs along a reach, with positions by RTK and verticals to 0.3 degrees."""
    turn = heading_rotation(torch.tensor(-0.46).double())
    up = torch.nn.functional.normalize(torch.cat((SLOPE, torch.ones(1).double())), dim=0)
    level_from_water = levelling(-up)
    x, y = torch.meshgrid(torch.linspace(-0.5, 0.5, 6), torch.tensor((-2.0, 2.0)), indexing="ij")
    center = torch.stack((REACH * x, y, torch.full_like(x, FLIGHT)), dim=-1).reshape(-1, 3).double()
    center = (center + 0.3 * draw.normal(*center.shape)) @ turn.mT
    down = torch.nn.functional.normalize(0.12 * draw.normal(len(center), 3) + torch.eye(3)[2].double(), dim=-1)
    rotation = level_rotation(down) @ heading_rotation(0.1 * draw.normal(len(center))) @ turn.mT
    reach = torch.tensor((0.55 * REACH, 0.5 * WIDTH, 1.0)).double()
    points = (draw.uniform(-1.0, 1.0, 300, 3) * reach + torch.tensor((0.0, 0.0, -1.5))) @ turn.mT
    basin = Basin(Intrinsics.create(1024, 768, 667.0), 1.33, rotation, center, points)
    pixels, seen = basin.project()
    track, image = seen.T.nonzero(as_tuple=True)
    names, sigma = tuple(f"{i:02d}.jpg" for i in range(len(center))), torch.tensor(POSITION).double()
    gravity = -rotate(rotation, up) + GRAVITY * draw.normal(len(center), 3)
    position = rotate(level_from_water, center) + torch.tensor((0.0, 0.0, HEIGHT)).double()
    capture = Capture(
        folder=tmp_path,
        names=names,
        paths=tuple(tmp_path / name for name in names),
        cameras=Cameras.of([basin.lens]),
        interfaces=Interfaces.level(basin.index_ratio),
        down_in_cam=torch.nn.functional.normalize(gravity, dim=-1),
        down_sigma=torch.full((len(center),), GRAVITY).double(),
        height=center[:, 2],
        has_height=torch.zeros(len(center), dtype=torch.bool),
        length_unit="m",
        position=position + sigma * draw.normal(*position.shape),
        position_sigma=sigma.repeat(len(center), 1),
    )
    number = torch.arange(len(points))
    colors = torch.stack((number % 256, number // 256, 0 * number), dim=-1).to(torch.uint8)
    observed = Observations(image, track, pixels[image, track] + NOISE * draw.normal(len(image), 2))
    photographed = Photographed(basin, capture, observed, colors, torch.zeros(len(image), dtype=torch.bool))
    return River(photographed, turn[:2, 0], level_from_water)


def bed_errors(scene, river) -> tuple[Tensor, Tensor]:
    """Heights of points in the level frame against those that are true, and how far these are along the reach."""
    number = scene.colors[:, 0].long() + 256 * scene.colors[:, 1].long()
    true = river.in_survey(river.photographed.basin.points[number])
    known = scene.assessment
    found = rotate(known.level_from_world, scene.points)[:, 2] + known.lowered_by
    return found - true[:, 2], true[:, :2] @ river.along


def at_ends(scene, river) -> list[float]:
    off, along = bed_errors(scene, river)
    return [float(off[along * side > 0.35 * REACH].median()) for side in (-1.0, 1.0)]


def slope_of(metrics, what="") -> Tensor:
    """Of the water to the east and to the north, or its sigma."""
    names = (f"water_slope_{name}{what}_mm_per_m" for name in ("east", "north"))
    return 1e-3 * torch.tensor([metrics[name] for name in names]).double()


def test_two_gauges_give_the_water_its_slope(river):
    names = river.photographed.capture.names

    scene = reconstruct_with(river.photographed, resolve({}, {}, [], names, river.gauges(0.004, -0.003)))

    metrics, true = summarize(scene), float(SLOPE @ river.along)
    slope, sigma = slope_of(metrics), slope_of(metrics, "_sigma")
    assert float(slope @ river.along) == pytest.approx(true, abs=2.0 * 2.0**0.5 * GAUGE / REACH)
    assert bool(((slope - SLOPE).abs() < 2.0 * sigma).all())
    assert scene.interfaces.is_level
    torch.testing.assert_close(torch.tensor(scene.assessment.slope).double(), slope)
    assert metrics["water_level_m"] == pytest.approx(HEIGHT, abs=2.0 * GAUGE / 2.0**0.5)
    assert metrics["water_level_sigma_m"] == pytest.approx(GAUGE / 2.0**0.5, rel=0.15)
    assert metrics["position_rms_vertical_m"] < 0.03
    assert contradicted(scene) == ()
    low, high, images = metrics["water_level_from"]
    assert high["height"] - low["height"] == pytest.approx(true * REACH - 0.007, abs=1e-6)
    assert (low["weight_percent"], high["weight_percent"]) == (pytest.approx(47.0, abs=5.0),) * 2
    assert 0.0 < images["weight_percent"] < 10.0
    assert all(abs(off) < 2.0 * POSITION[2] for off in at_ends(scene, river))


@pytest.mark.slow
def test_the_same_flight_over_level_water_is_deeper_at_one_end_and_shallower_at_the_other(river):
    names, level = river.photographed.capture.names, []
    for mark in river.gauges(0.0, 0.0):
        level.append(replace(mark, position=(None, None, mark.position[2]), sigma=0.05))

    scene = reconstruct_with(river.photographed, resolve({}, {}, [], names, level))

    metrics, fall = summarize(scene), 0.5 * float(SLOPE @ river.along) * REACH
    assert "water_slope_east_mm_per_m" not in metrics
    assert scene.assessment.slope == (0.0, 0.0)
    off = [metrics["water_level_m"] - HEIGHT + by for by in (fall, -fall)]
    assert max(off) - min(off) > 0.07
    assert max(map(abs, off)) > 0.036


@pytest.mark.slow
def test_a_gauge_that_contradicts_the_other_and_the_images_is_named_and_not_used(river):
    names = river.photographed.capture.names
    scene = reconstruct_with(river.photographed, resolve({}, {}, [], names, river.gauges(0.0, 1.0)))

    (found,) = contradicted(scene)
    assert found.code == "water_level_contradicts"
    assert found.message.startswith("gauge high states the water at 421 m, 1")
    assert "it was not used" in found.message
    assert "water_slope_east_mm_per_m" not in summarize(scene)
    low, high, _ = summarize(scene)["water_level_from"]
    assert (low["weight_percent"] > 50.0, high["weight_percent"]) == (True, 0.0)


def test_an_adjustment_tilts_the_water_by_the_same_gauges(river):
    survey = river.stated(*river.gauges(0.004, -0.003))

    scene, _ = readjust(river.by_level_water(), survey)

    normal, metrics = scene.interfaces.normal[0], slope_metrics(scene, survey)
    torch.testing.assert_close(slope_of(metrics), -normal[:2] / normal[2])
    assert bool(((slope_of(metrics) - SLOPE).abs() < 2.0 * slope_of(metrics, "_sigma")).all())
    assert float(slope_of(metrics) @ river.along) == pytest.approx(float(SLOPE @ river.along), abs=8e-4)
    assert survey_contradictions(scene, survey, survey) == ()


def test_an_adjustment_in_the_frame_of_sloping_water_leaves_it_where_it_is(river):
    """As of a run whose georeference says how its frame slopes: what is up comes from there."""
    level = river.stated(*river.gauges(0.0, 0.0))
    flat = river.photographed.scene(with_points=True)
    back = Rigid(river.level_from_water, -river.level_from_water.mT @ torch.tensor((0.0, 0.0, HEIGHT)).double()).inverse

    found, _ = readjust(river.by_level_water(), level)
    again, _ = readjust(flat, level.moved(back))

    torch.testing.assert_close(again.points, back.apply(found.points), rtol=0.0, atol=1e-4)
    assert slope_metrics(again, level.moved(back)) == pytest.approx(slope_metrics(found, level), rel=1e-2, abs=1e-3)


def test_a_survey_that_is_moved_says_the_same(river, draw):
    survey = river.stated(*river.gauges(0.0, 0.0), WaterMark("water_level", (None, None, HEIGHT), 0.02))
    scene = river.by_level_water()
    motion = Rigid(
        levelling(torch.nn.functional.normalize(torch.tensor((0.02, -0.01, -1.0)).double(), dim=0)), draw.normal(3)
    )
    shift = -rotate(motion.rotation, motion.center)
    turned = moved(scene, Similarity(torch.ones(()).double(), motion.rotation, shift))
    layout = Layout.create(scene, ("plane_tilt", "plane_height"))

    for one, other in zip(terms(survey, scene), terms(survey.moved(motion), turned), strict=True):
        before, after = one.residuals(scene, layout).value, other.residuals(turned, layout).value
        torch.testing.assert_close(after.square().sum(), before.square().sum(), rtol=1e-6, atol=1e-6)


def terms(survey, scene):
    return survey_terms(survey, scene.part(), len(scene.points))


@pytest.mark.parametrize(
    ("off", "used"),
    [
        ((0.0, 0.0, 0.0), (True, True, True)),
        ((0.0, 0.5, 0.0), (True, False, True)),
        ((0.0, 0.0, -0.5), (True, True, False)),
    ],
)
def test_the_level_that_is_not_in_one_plane_with_the_others_is_left_out(river, off, used):
    x = torch.tensor((-18.0, 2.0, 18.0)).double()
    heights = HEIGHT + 0.002 * x + torch.tensor(off).double()
    marks = [WaterMark(f"{i}", (at, 0.3, z), 0.01) for i, (at, z) in enumerate(zip(x.tolist(), heights, strict=True))]
    scene = replace(river.by_level_water(), interfaces=Interfaces.level(1.33, HEIGHT + 0.02))
    levels = StatedLevels.of(resolve({}, {}, [], scene.views.names, marks), scene)

    assert levels.show_slope(scene)
    assert tuple(levels.agree_on_slope(scene, torch.tensor((0.02,)).double()).tolist()) == used


def test_places_close_together_and_heights_without_a_place_show_no_slope(river):
    scene = river.by_level_water()
    for places in (((0.0, 0.0), (0.5, 0.0)), ((None, None), (40.0, 0.0))):
        marks = [WaterMark(str(i), (*place, HEIGHT), 0.01) for i, place in enumerate(places)]
        assert not StatedLevels.of(resolve({}, {}, [], scene.views.names, marks), scene).show_slope(scene)


def test_the_variance_of_a_level_is_that_of_a_plane_that_turns_and_rises(river):
    survey = river.stated(*river.gauges(0.0, 0.0))
    scene, outcome = readjust(river.by_level_water(), survey)
    problem, places = outcome.report.problem, torch.tensor(((3.0, -7.0), (-11.0, 2.0))).double()
    known = uncertainty(problem, outcome.report.scene)
    columns = known.layout.plane_columns(known.layout.interfaces)[0]

    def heights(change):
        plane = scene.interfaces.planes.moved(change[None, :2], change[None, 2])
        normal = plane.normal_like(change)[0]
        return (plane.offset[0] - places @ normal[:2]) / normal[2]

    rises = torch.func.jacrev(heights)(torch.zeros(3).double())
    wanted = rises @ known.covariance[columns[:, None], columns] @ rises.mT
    one = torch.zeros(1, dtype=torch.long)
    for first, second in ((0, 0), (0, 1), (1, 1)):
        found = scene.assessment.level_variance(one, places[first : first + 1], places[second : second + 1])
        assert float(found) == pytest.approx(float(wanted[first, second]), rel=0.02)
