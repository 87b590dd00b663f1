"""How well water, intrinsics and scale are determined: as dense algebra says, the same in every gauge, readable."""

import math
from dataclasses import replace

import pytest
import torch

from tests.bundle.bundle_oracles import jacobian_of, weighted_residuals
from tests.bundle.changes import changed
from torchrefrac.bundle import (
    BundleOptions,
    BundleProblem,
    CenterPrior,
    Determination,
    Expectations,
    GravityPrior,
    HeightPrior,
    ScaleBars,
    adjust,
    determinations,
)
from torchrefrac.bundle.gauge import similarity_motions
from torchrefrac.bundle.layout import Layout
from torchrefrac.bundle.observability import UNITS, USEFUL, WORDS, undetermined
from torchrefrac.camera import Intrinsics
from torchrefrac.geometry import Rigid
from torchrefrac.scene import Interfaces, Observations, Scene

SIGMA = 0.3
OPTIONS = BundleOptions(loss="squared", pixel_sigma=SIGMA)
ONE = torch.ones(1, dtype=torch.float64)
WATER = ("index_ratio", "plane_tilt", "plane_height")
INTRINSICS = ("focal", "principal_point", "distortion")


def _found(planted, **changes):
    """By name."""
    problem = planted.problem(**changes)
    return {found.name: found for found in determinations(problem, planted.truth, SIGMA)}


def _height(truth, sigma, image=1):
    return HeightPrior(torch.tensor([image]), truth.views.center[image : image + 1, 2], sigma * ONE)


def _bar(truth, sigma):
    length = (truth.points[4] - truth.points[9]).norm()[None]
    return ScaleBars(torch.tensor([4]), torch.tensor([9]), length, sigma * ONE)


def _centers(truth, *images, sigma=1.0):
    index = torch.tensor(images)
    information = torch.eye(3, dtype=torch.float64).expand(len(index), 3, 3) / sigma**2
    return CenterPrior(index, truth.views.center[index], information)


def test_the_index_ratio_is_seen_through_water(plant, disturb):
    planted = plant(views=5, points=40, noise=SIGMA)
    start = changed(disturb(planted.truth, size=0.2), index_ratio=torch.tensor(1.30, dtype=torch.float64))

    report = planted.adjusted(start, refine=("index_ratio",), terms=[planted.gravity])

    found = _found(planted)["index_ratio"]
    assert report.fixed == {}
    assert found.posterior < 0.02
    assert abs(report.scene.interfaces.index_ratio - planted.truth.interfaces.index_ratio) < 3.0 * found.posterior
    assert report.scene.interfaces.index_ratio != 1.30


def test_over_land_alone_it_is_not_and_the_adjustment_fixes_it_and_reports_so(plant, disturb):
    planted = plant(views=5, points=20, land=20)
    start = disturb(planted.truth, size=0.2)

    report = planted.adjusted(start, refine=WATER, pixel_sigma=SIGMA)

    assert report.fixed == {
        "index_ratio": "index ratio: not determined",
        "plane_tilt": "tilt of the water to the cameras: not determined",
        "plane_height": "height of cameras above the water, relative: not determined",
    }
    assert report.problem.layout.water == ()
    assert torch.equal(report.scene.interfaces.index_ratio, start.interfaces.index_ratio)
    assert report.scene.interfaces is start.interfaces
    assert report.costs[-1] < 1e-10


def test_what_is_not_seen_is_refined_where_this_is_asked_for(plant, disturb):
    planted = plant(views=5, points=20, land=20)

    report = planted.adjusted(disturb(planted.truth, size=0.2), refine=("index_ratio", "focal"), refine_unseen=True)

    assert report.fixed == {}
    assert (report.problem.layout.intrinsics, report.problem.layout.water) == (("focal",), ("index_ratio",))


def test_what_is_not_seen_but_expected_is_refined_and_stays_as_expected(plant, disturb):
    planted = plant(views=5, points=20, land=20)
    start = disturb(planted.truth, size=0.2)
    expected = Expectations(index_ratio=0.01)

    report = planted.adjusted(start, refine=("index_ratio",), expected=expected)

    assert report.fixed == {}
    assert report.problem.layout.water == ("index_ratio",)
    torch.testing.assert_close(report.scene.interfaces.index_ratio, start.interfaces.index_ratio, rtol=0.0, atol=1e-12)
    found = _found(planted, refine=("index_ratio",), expected=expected)["index_ratio"]
    assert found.posterior == pytest.approx(0.01, rel=1e-3)
    assert found.sentence == "index ratio: determined to 0.01, which is what was known before"


def test_only_what_the_data_do_not_determine_is_fixed(plant, disturb):
    planted = plant(views=5, points=30, land=30)

    report = planted.adjusted(disturb(planted.truth, size=0.1), refine=("focal", "index_ratio"))

    assert set(report.fixed) == {"index_ratio"}
    assert report.problem.layout.intrinsics == ("focal",)


@pytest.mark.parametrize(
    ("name", "unit"), [("focal", "focal length, relative"), ("principal_point", "principal point")]
)
@pytest.mark.parametrize("many", [1, 200], ids=["100 observations", "20000 observations"])
def test_the_intrinsics_of_level_cameras_in_air_is_not_determined(draw, name, unit, many):
    """Stretching the scene along the view, or shearing it, makes up for it."""
    start = _nadir(draw, points=20 * many)

    report = adjust(start, replace(OPTIONS, refine=(name,)))

    assert report.fixed == {name: f"{unit}: not determined"}
    assert torch.equal(report.scene.cameras.focal, start.cameras.focal)
    assert torch.equal(report.scene.cameras.principal_point, start.cameras.principal_point)


def test_tilted_cameras_determine_it(plant):
    found = _found(plant(views=5, points=40, index_ratio=1.0), refine=INTRINSICS)

    assert 0.0 < found["focal"].posterior < 0.05
    assert 0.0 < found["principal_point"].posterior < 50.0
    assert 0.0 < found["distortion"].posterior < math.inf


@pytest.mark.parametrize("interfaces", [1, 2])
def test_water_and_intrinsics_are_as_well_determined_as_dense_algebra_says(plant, interfaces):
    """The covariance under the constraint that the cameras as a whole neither shift nor turn nor grow; a shift counts
    over the height above the water."""
    planted = plant(views=5, points=40, interfaces=interfaces)
    truth = planted.truth
    layout = Layout.create(truth, ("focal", *WATER))
    problem = BundleProblem.create(truth, layout, OPTIONS)

    found = {d.name: d for d in determinations(problem, truth, SIGMA)}

    jacobian = jacobian_of(weighted_residuals(problem, planted.observations, truth), layout, truth)
    border = torch.zeros(jacobian.shape[1], 7, dtype=torch.float64)
    of, water = truth.views.interface, truth.interfaces
    height = (water.normal[of] * truth.views.center).sum(-1) - water.offset[of]
    counts = torch.tensor((1.0, 1.0, 1.0, *3 * (1.0 / height.mean(),)), dtype=torch.float64).repeat(5)[:, None]
    border[:30] = counts.square() * similarity_motions(truth, layout)[0][:30]
    covariance = SIGMA**2 * _bordered_inverse(jacobian, border)
    sigma = covariance.diagonal().sqrt()
    by_height = jacobian_of(lambda state: _mean_heights(changed(state, center=truth.views.center)), layout, truth)
    above = (by_height @ covariance @ by_height.T).diagonal().sqrt()
    by_plane = sigma[layout.plane_columns(torch.arange(interfaces))]
    assert found["index_ratio"].posterior == pytest.approx(float(sigma[layout.medium_column("index_ratio")]), rel=1e-3)
    assert found["focal"].posterior == pytest.approx(float(sigma[30]), rel=1e-3)
    assert found["plane_tilt"].posterior == pytest.approx(math.degrees(by_plane[:, :2].max()), rel=1e-3)
    assert found["plane_height"].posterior == pytest.approx(float(above.max() / height.mean()), rel=1e-3)
    assert found["scale"].posterior == math.inf


@pytest.mark.parametrize("gauge", ["position, gravity and length", "seven unknowns fixed"])
def test_what_fixes_the_gauge_and_no_more_changes_nothing_about_water_and_intrinsics(plant, gauge):
    planted = plant(views=5, points=40)
    truth = planted.truth
    free = _found(planted, refine=("focal",))

    if gauge == "seven unknowns fixed":
        fixed = torch.zeros(5, 6, dtype=torch.bool)
        fixed[0] = fixed[3, 4] = True
        found = _found(planted, refine=("focal",), fixed=fixed)
    else:
        gravity = GravityPrior(planted.down_in_cam[2:3], 0.3, torch.tensor([2]))
        found = _found(planted, refine=("focal",), terms=[_centers(truth, 1), gravity, _bar(truth, 2.0)])

    for name in ("index_ratio", "plane_tilt", "plane_height", "focal"):
        assert found[name].posterior == pytest.approx(free[name].posterior, rel=1e-4)


def test_where_the_scene_lies_and_how_large_it_is_changes_nothing(plant):
    planted = plant(views=5, points=40)
    shift = torch.tensor((3000.0, -8000.0, 0.0), dtype=torch.float64)
    truth = planted.truth
    other = replace(
        planted, truth=changed(truth, center=10 * truth.views.center + shift, points=10 * truth.points + shift)
    )

    here, there = (_found(p, terms=[_height(p.truth, s)]) for p, s in ((planted, 0.4), (other, 4.0)))

    for name in here:
        assert there[name].posterior == pytest.approx(here[name].posterior, rel=1e-3)


@pytest.mark.parametrize("where", [0.0, 5000.0])
def test_without_a_length_the_scale_is_not_determined(plant, where):
    planted = _shifted(plant(views=5, points=40), where)

    for terms in ([], [planted.gravity], [_centers(planted.truth, 1)], [_centers(planted.truth, 1), planted.gravity]):
        found = _found(planted, terms=terms)["scale"]
        assert found.posterior == math.inf
        assert found.sentence == "scale, relative: not determined"


@pytest.mark.parametrize("where", [0.0, 5000.0])
def test_with_one_it_is_as_well_as_the_length_is_known(plant, where):
    planted = _shifted(plant(views=5, points=40), where)
    truth = planted.truth
    length = float((truth.points[4] - truth.points[9]).norm())
    problems = {
        0.5 / float(truth.views.center[1, 2]): [_height(truth, 0.5)],
        1.5 / length: [_bar(truth, 1.5)],
        1.2 / length: [planted.gravity, _centers(truth, 1), _bar(truth, 1.2)],
        0.7 / float((truth.views.center[0] - truth.views.center[4]).norm()) * 2.0**0.5: [
            _centers(truth, 0, 4, sigma=0.7)
        ],
    }

    for sigma, terms in problems.items():
        found = {d.name: d for d in determinations(planted.problem(terms=terms), truth, 1e-3)}["scale"]
        assert found.posterior == pytest.approx(sigma, rel=0.02)


def test_two_lengths_determine_the_scale_better_than_one(plant):
    planted = plant(views=5, points=40)
    bar, length = _bar(planted.truth, 1.0), float((planted.truth.points[4] - planted.truth.points[9]).norm())

    found = {d.name: d for d in determinations(planted.problem(terms=[bar, bar]), planted.truth, 1e-3)}["scale"]

    assert found.posterior == pytest.approx(0.5**0.5 / length, rel=0.02)


@pytest.mark.parametrize("refined", [(), WATER], ids=["fixed", "refined"])
def test_what_was_known_before_counts_whether_or_not_it_is_refined(plant, refined):
    planted = plant(views=5, points=20)
    expected = Expectations(index_ratio=1e-4, plane_tilt_deg=1e-3, plane_height=1e-3)

    found = _found(planted, refine=refined, expected=expected)

    height = float(planted.truth.views.center[:, 2].mean())
    assert found["index_ratio"].posterior == pytest.approx(1e-4, rel=0.02)
    assert (found["index_ratio"].prior, found["plane_height"].prior) == (1e-4, pytest.approx(1e-3 / height))
    assert found["plane_tilt"].prior == pytest.approx(1e-3)
    assert all(d.useful for d in found.values())


def test_at_an_index_ratio_of_exactly_one_there_is_no_plane_to_be_seen(plant):
    planted = plant(views=5, points=30, index_ratio=1.0)

    found = _found(planted, refine=WATER)

    assert found["index_ratio"].posterior < 0.05
    assert found["plane_tilt"].posterior == found["plane_height"].posterior == math.inf
    report = planted.adjusted(planted.truth, refine=WATER)
    assert set(report.fixed) == {"plane_tilt", "plane_height"}
    assert report.scene.interfaces.index_ratio == pytest.approx(1.0, abs=1e-6)


def test_nothing_is_asked_of_what_is_not_refined(plant):
    planted = plant(views=5, points=20, land=20)

    assert undetermined(planted.problem(), planted.truth, SIGMA) == {}
    assert list(_found(planted)) == [*WATER, "scale"]
    assert list(_found(planted, refine=("radial", "focal"))) == ["focal", "radial", *WATER, "scale"]


def test_where_not_even_the_cameras_are_determined_nothing_is_fixed(plant):
    planted = plant(views=5, points=20)
    alone = planted.without(planted.observations.view == 3).problem(terms=[planted.gravity], refine=("index_ratio",))

    assert undetermined(alone, planted.truth, SIGMA) == {}


def test_every_determination_reads_as_one_short_sentence_with_its_unit():
    assert set(USEFUL) < set(WORDS)
    for name in WORDS:
        for posterior in (math.inf, 0.0, 1.2345e-7, 0.0123, 123.4):
            for prior in (None, 1e-9, 0.0246):
                found = Determination(name, posterior, prior)
                assert len(found.sentence) <= 110
                assert found.sentence.startswith(WORDS[name] + ": ")
                if not math.isinf(posterior):
                    assert f"{posterior:.2g}{UNITS.get(name, '')}" in found.sentence


def test_a_sentence_says_what_was_gained():
    assert Determination("plane_tilt", 0.02, 0.5).sentence == (
        "tilt of the water to the cameras: determined to 0.02 degrees (known to 0.5 degrees before)"
    )
    assert Determination("principal_point", 3.0).sentence == "principal point: determined to 3 px"


def test_what_is_not_refined_says_how_well_it_would_have_to_be_known():
    sentence = "index ratio: determined to 0.21, but must be to 0.05 to be refined"
    assert Determination("index_ratio", 0.21).sentence == sentence
    assert Determination("plane_tilt", math.inf).sentence == "tilt of the water to the cameras: not determined"


@pytest.mark.parametrize("name", USEFUL)
def test_useful_is_what_is_determined_well_enough_or_was_known_before(name):
    assert Determination(name, 0.99 * USEFUL[name]).useful
    assert not Determination(name, 1.01 * USEFUL[name]).useful
    assert not Determination(name, math.inf).useful
    assert Determination(name, math.inf, 1.0).useful


def _mean_heights(state):
    """Of the cameras of each plane above it."""
    of, normal, offset = state.views.interface, state.interfaces.normal, state.interfaces.offset
    above = (normal[of] * state.views.center).sum(dim=-1) - offset[of]
    return torch.stack([above[of == plane].mean() for plane in range(len(offset))])


def _shifted(planted, x):
    shift = torch.tensor((x, 0.5 * x, 0.0), dtype=torch.float64)
    truth = planted.truth
    return replace(planted, truth=changed(truth, center=truth.views.center + shift, points=truth.points + shift))


def _nadir(draw, points):
    """Five cameras that look straight down from several heights, in air, and all pixels of some points."""
    turn = torch.diag(torch.tensor((1.0, -1.0, -1.0), dtype=torch.float64)).expand(5, 3, 3)
    center = torch.cat((draw.uniform(-30.0, 30.0, 5, 2), draw.uniform(30.0, 40.0, 5, 1)), dim=-1)
    below = torch.cat((draw.uniform(-40.0, 40.0, points, 2), draw.uniform(-100.0, -20.0, points, 1)), dim=-1)
    view, point = torch.arange(5).repeat(points), torch.arange(points).repeat_interleave(5)
    intrinsics, pixels = Intrinsics.create(1024, 768, 667.0), torch.zeros(5 * points, 2, dtype=torch.float64)
    seen = Observations(view, point, pixels)
    scene = Scene.create(Rigid(turn, center), intrinsics, Interfaces.level(1.0), below, seen)
    pixels, valid = scene.camera_of(view).project(below[point])
    assert valid.all()
    return changed(scene, observations=replace(seen, pixels=pixels + 0.1 * draw.normal(*pixels.shape)))


def _bordered_inverse(jacobian, border):
    """Of [H C; C^T 0]."""
    unit = jacobian.norm(dim=0).clamp(min=1e-300)
    scaled, border = jacobian / unit, torch.linalg.qr(border / unit[:, None]).Q
    count = border.shape[1]
    upper = torch.cat((scaled.T @ scaled, border), dim=1)
    lower = torch.cat((border.T, torch.zeros(count, count, dtype=torch.float64)), dim=1)
    return torch.linalg.inv(torch.cat((upper, lower)))[: len(unit), : len(unit)] / unit[:, None] / unit
