"""Adjusting an existing alignment anew: from poses of a pinhole to those of the truth, and what is refused."""

from dataclasses import replace

import pytest
import torch

from tests.planted_alignments import plant_alignment
from torchrefrac.bundle import BundleOptions, UnadjustableError
from torchrefrac.files.water import Water
from torchrefrac.recorder import SilentRecorder
from torchrefrac.scene import Survey, SurveyError
from torchrefrac.scene.survey import ScaleBar, SurveyedImage, SurveyedMark, resolve
from torchrefrac.sfm.readjust import ReadjustOptions, readjust
from torchrefrac.sfm.water_level import candidate_offsets, find_offset

SMALL = (1e4 * torch.eye(3, dtype=torch.float64)).tolist()  # information of a position known to 0.01


class Notes(SilentRecorder):
    """Keeps the lines that a person should see."""

    def __init__(self):
        self.lines = []

    def note(self, text):
        self.lines.append(text)


@pytest.fixture
def plant(make_basin, draw):
    """`plant(noise=0.0, lenses=1, planes=1, ...)`: six cameras and 80 points; the rest goes to `make_basin`."""

    def make(noise=0.0, lenses=1, planes=1, **scene):
        basin = make_basin(**{"cameras": 6, "points": 80, "seen_by": 3} | scene)
        return plant_alignment(basin, draw, noise, lenses, planes)

    return make


def options(*refine, **changes):
    """That converge as far as float64 goes."""
    bundle = BundleOptions(loss_scale=1.0, pixel_sigma=0.5, refine=refine)
    solver = replace(bundle.solver, max_iterations=200, function_tolerance=1e-13)
    return ReadjustOptions(bundle=replace(bundle, solver=solver), **changes)


@pytest.mark.parametrize("scene", [{}, {"lenses": 2}, {"planes": 2}, {"land": 20}])
def test_cameras_of_a_pinhole_come_to_the_truth(plant, draw, scene):
    planted = plant(**scene)
    given = planted.as_of_a_pinhole(draw)
    if "planes" in scene:  # two planes fix more of the frame: only where the cameras stand along their line is free
        given = replace(given, center=planted.truth.center + 0.2 * (given.center - planted.truth.center))

    found = readjust(given, planted.water, options=options())

    assert float(found.errors_before.median()) > 1.0
    assert float(found.errors.max()) < 1e-4
    if "planes" not in scene:
        assert float(planted.off(found.alignment).max()) < 1e-3
    assert found.alignment.names == given.names
    assert torch.equal(found.alignment.lens, given.lens)
    for lens, other in zip(found.alignment.lenses, given.lenses, strict=True):
        assert (lens.width, lens.height) == (other.width, other.height)
        assert torch.equal(lens.focal, other.focal)


def test_points_and_colours_stay_together(plant, draw):
    planted = plant()

    found = readjust(planted.as_of_a_pinhole(draw, 0.0), planted.water, options=options()).alignment

    assert torch.equal(found.colors, planted.truth.colors)
    torch.testing.assert_close(found.points, planted.truth.points, rtol=0.0, atol=1e-5)
    assert torch.equal(found.pixels, planted.truth.pixels)


def test_a_frame_that_nothing_fixes_stays_where_it_is(plant, draw):
    planted = plant()

    found = readjust(planted.as_of_a_pinhole(draw, 0.0), planted.water, options=options())

    assert float(found.shift.max()) < 1e-5


def test_the_index_ratio_is_found_from_a_wrong_one(plant, draw):
    planted = plant()
    water = replace(planted.water, index_ratio=1.25)

    found = readjust(planted.as_of_a_pinhole(draw), water, options=options("index_ratio"))

    assert found.water.index_ratio == pytest.approx(1.33, abs=1e-5)
    assert float(planted.off(found.alignment).max()) < 1e-3
    assert found.assessment.index_ratio_sigma is not None
    assert any(line.startswith("index ratio: determined to") for line in found.assessment.determined)


def test_both_focal_lengths_are_found_from_wrong_ones(plant, draw):
    planted = plant(lenses=2, points=200)
    given = planted.as_of_a_pinhole(draw, 0.2)
    lenses = tuple(replace(lens, focal=lens.focal * 1.02) for lens in given.lenses)

    found = readjust(replace(given, lenses=lenses), planted.water, options=options("focal"))

    for lens, truth in zip(found.alignment.lenses, planted.truth.lenses, strict=True):
        torch.testing.assert_close(lens.focal, truth.focal, rtol=1e-5, atol=0.0)


def test_wrong_observations_are_dropped_and_no_others(plant, draw):
    planted = plant(noise=0.2, points=150, cameras=8, seen_by=6)
    wrong = torch.zeros(len(planted.truth.image), dtype=torch.bool)
    wrong[::15] = True
    pixels = planted.truth.pixels + 40.0 * wrong[:, None] * draw.directions(len(wrong))[:, :2].sign()
    given = replace(planted.as_of_a_pinhole(draw), pixels=pixels)

    found = readjust(given, planted.water, options=options())

    kept = {tuple(row) for row in found.alignment.pixels.tolist()}
    assert not kept & {tuple(row) for row in pixels[wrong].tolist()}
    assert len(kept) == int((~wrong).sum())
    assert float(planted.off(found.alignment).max()) < 0.1


def test_an_image_that_does_not_fit_is_left_out_and_named(plant, draw):
    planted = plant(noise=0.2, points=150)
    off = planted.truth.image == 4
    pixels = torch.where(off[:, None], draw.uniform(0.0, 768.0, len(off), 2), planted.truth.pixels)

    found = readjust(replace(planted.as_of_a_pinhole(draw), pixels=pixels), planted.water, options=options())

    assert found.lost_images == ("cam04.jpg",)
    assert found.alignment.names == tuple(name for name in planted.truth.names if name != "cam04.jpg")
    assert found.images.tolist() == [0, 1, 2, 3, 5]
    assert float(planted.off(found.alignment).max()) < 0.2


def test_held_cameras_stay_to_the_last_bit(plant, draw):
    planted = plant()
    given = planted.as_of_a_pinhole(draw, 0.0)
    water = replace(planted.water, offset=torch.tensor([3.0], dtype=torch.float64))

    found = readjust(given, water, options=options("plane_height", held="cameras"))

    assert torch.equal(found.alignment.center, given.center)
    assert torch.equal(found.alignment.rotation, given.rotation)
    assert float(found.water.offset) == pytest.approx(0.0, abs=1e-4)
    torch.testing.assert_close(found.alignment.points, planted.truth.points, rtol=0.0, atol=1e-3)


def test_measured_heights_fix_the_scale(plant, draw):
    planted = plant()
    given = planted.as_of_a_pinhole(draw)
    given = replace(given, center=0.4 * given.center, points=0.4 * given.points)
    heights = {
        name: SurveyedImage(height=(float(c[2]), 0.1))
        for name, c in zip(planted.truth.names, planted.truth.center, strict=True)
    }

    found = readjust(given, planted.water, resolve(heights, {}, [], given.names), options())

    torch.testing.assert_close(found.alignment.center[:, 2], planted.truth.center[:, 2], rtol=0.0, atol=1e-3)


def _mark(planted, point, **known):
    """A mark at a point of the truth, seen where this is."""
    rows = (planted.truth.point == point).nonzero()[:, 0]
    names = [planted.truth.names[i] for i in planted.truth.image[rows].tolist()]
    return SurveyedMark(dict(zip(names, planted.truth.pixels[rows].tolist(), strict=True)), **known)


def test_known_marks_fix_the_whole_frame(plant, draw):
    planted = plant(noise=0.05)
    known = {f"m{i}": _mark(planted, i, known=(planted.truth.points[i].tolist(), SMALL)) for i in range(4)}
    given = planted.as_of_a_pinhole(draw)

    found = readjust(given, planted.water, resolve({}, known, [], given.names), options())

    torch.testing.assert_close(found.alignment.center, planted.truth.center, rtol=0.0, atol=0.05)
    assert found.marks["m2"] == pytest.approx(planted.truth.points[2].tolist(), abs=0.03)
    assert len(found.alignment.points) == len(planted.truth.points)
    assert len(found.assessment.point_sigma) == len(planted.truth.points)


def test_a_mark_that_one_image_sees_goes_by_its_known_position(plant, draw):
    planted = plant()
    mark = _mark(planted, 0, known=(planted.truth.points[0].tolist(), SMALL))
    once = replace(mark, pixels=dict(list(mark.pixels.items())[:1]))
    given = planted.as_of_a_pinhole(draw)

    found = readjust(given, planted.water, resolve({}, {"once": once}, [], given.names), options())

    assert found.lost_marks == ()
    assert found.marks["once"] == pytest.approx(planted.truth.points[0].tolist(), abs=1e-2)
    assert float(planted.off(found.alignment).max()) < 1e-2


def test_a_scale_bar_fixes_the_scale(plant, draw):
    planted = plant()
    length = float((planted.truth.points[0] - planted.truth.points[1]).norm())
    marks, bar = {"a": _mark(planted, 0), "b": _mark(planted, 1)}, ScaleBar("a", "b", 2.0 * length, 0.01)
    given = planted.as_of_a_pinhole(draw)

    found = readjust(given, planted.water, resolve({}, marks, [bar], given.names), options())

    torch.testing.assert_close(found.alignment.center[:, 2], 2.0 * planted.truth.center[:, 2], rtol=0.0, atol=1e-2)


def test_a_mark_on_the_waterline_fixes_the_height_of_the_plane(plant, draw):
    planted = plant(land=20)
    point = int((planted.truth.points[:, 2].abs()).argmin())
    level = float(planted.truth.points[point, 2])
    mark = replace(_mark(planted, point), waterline=0.001)
    given = planted.as_of_a_pinhole(draw, 0.0)

    found = readjust(
        given, planted.water, resolve({}, {"edge": mark}, [], given.names), options("plane_height", held="cameras")
    )

    height = float(found.marks["edge"][2] - found.water.offset)
    assert abs(height) < abs(level)


def test_a_mark_that_does_not_fit_is_named(plant, draw):
    planted = plant()
    mark = _mark(planted, 0)
    pixels = {name: [x + 60.0 * (-1) ** i, y + 50.0] for i, (name, (x, y)) in enumerate(mark.pixels.items())}
    given = planted.as_of_a_pinhole(draw)

    found = readjust(
        given, planted.water, resolve({}, {"bad": replace(mark, pixels=pixels)}, [], given.names), options()
    )

    assert found.lost_marks == ("bad",)
    assert float(planted.off(found.alignment).max()) < 1e-2


def test_the_water_level_is_found_between_points_and_cameras(plant, draw):
    planted = plant(points=120)
    given = planted.as_of_a_pinhole(draw)
    up = given.center.new_tensor((0.0, 0.0, 500.0))
    raised = replace(given, center=given.center + up, points=given.points + up)

    offset = find_offset(raised, planted.water, options=options())
    water = replace(planted.water, offset=torch.tensor([offset], dtype=torch.float64))
    found = readjust(raised, water, options=options("plane_height"))

    assert 400.0 < offset < 530.0
    above = found.alignment.center - found.water.offset * found.water.normal
    assert float(planted.off(replace(found.alignment, center=above)).max()) < 1e-2


def test_candidates_for_the_water_level_lie_below_all_cameras(plant, draw):
    given = plant().as_of_a_pinhole(draw)

    offsets = candidate_offsets(given, given.center.new_tensor((0.0, 0.0, 1.0)))

    assert bool((offsets < given.center[:, 2].min()).all())
    assert bool((offsets.diff() > 0).all())
    with pytest.raises(UnadjustableError, match="the cameras are not above the points along the normal"):
        candidate_offsets(given, given.center.new_tensor((0.0, 0.0, -1.0)))


def test_a_plane_below_the_points_is_remarked_upon(plant, draw):
    planted = plant()
    low = replace(planted.water, offset=torch.tensor([-500.0], dtype=torch.float64))
    notes = Notes()

    readjust(planted.as_of_a_pinhole(draw), low, options=ReadjustOptions(rounds=1), recorder=notes)

    assert notes.lines[0].startswith("80 of 80 points lie above the water, where nothing refracts")


def test_points_that_cannot_be_triangulated_are_counted_and_left_out(plant, draw):
    planted = plant()
    given = planted.as_of_a_pinhole(draw, 0.0)
    twin = given.pixels.clone()
    rows = (given.point == 7).nonzero()[:, 0]
    twin[rows] = given.pixels.new_tensor((512.0, 384.0)) + 300.0 * draw.normal(len(rows), 2)

    found = readjust(replace(given, pixels=twin), planted.water, options=options())

    assert len(found.alignment.points) == len(given.points) - 1
    assert torch.equal(found.alignment.colors, torch.cat((given.colors[:7], given.colors[8:])))


@pytest.mark.parametrize(
    ("spoil", "sentence"),
    [
        (lambda a: a.of_images(torch.arange(len(a)) == 0), "the alignment has 1 image"),
        (lambda a: replace(a, pixels=a.pixels.index_fill(0, torch.tensor([3]), torch.nan)), "pixels are not finite"),
        (
            lambda a: replace(a, center=a.center.index_fill(0, torch.tensor([2]), -1.0)),
            "not above the water plane: cam02.jpg",
        ),
        (lambda a: replace(a, rotation=a.rotation * torch.nan), "rotation is not finite"),
    ],
)
def test_what_cannot_be_adjusted_is_said_with_the_names_of_images(plant, spoil, sentence):
    planted = plant()

    with pytest.raises(UnadjustableError, match=sentence):
        readjust(spoil(planted.truth), planted.water)


def test_images_that_nothing_connects_are_named(plant):
    planted = plant()
    truth = planted.truth
    apart = truth.image < 4
    keep = torch.where(truth.point % 2 == 0, apart, ~apart)
    split = replace(truth, image=truth.image[keep], point=truth.point[keep], pixels=truth.pixels[keep]).cleaned()

    with pytest.raises(UnadjustableError, match=r"no common points connect the images: 2 parts.*cam04.jpg, cam05.jpg"):
        readjust(split, planted.water)


def test_measured_gravity_wants_a_frame_whose_z_points_up(plant):
    planted = plant()
    down = {
        name: SurveyedImage(down=((-rotation[:, 2]).tolist(), 0.01))
        for name, rotation in zip(planted.truth.names, planted.truth.rotation, strict=True)
    }
    turn = torch.tensor(((1.0, 0.0, 0.0), (0.0, 0.0, -1.0), (0.0, 1.0, 0.0)), dtype=torch.float64)
    turned = replace(planted.truth, rotation=planted.truth.rotation @ turn.T, center=planted.truth.center @ turn.T)
    water = Water(1.33, turn[:, 2][None], planted.water.offset)

    with pytest.raises(SurveyError, match="disagree by 90 degrees"):
        readjust(turned, water, resolve(down, {}, [], turned.names))
    readjust(turned, water, Survey.empty(turned.names))


def test_options_that_cannot_work_are_refused():
    with pytest.raises(ValueError, match="rounds is 0, but must be finite and at least 1"):
        ReadjustOptions(rounds=0)
    with pytest.raises(ValueError, match="max_error is -1"):
        ReadjustOptions(max_error=-1.0)
