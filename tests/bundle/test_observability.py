"""What is said about water, lens and scale: true by dense algebra, the same in every gauge, and fit to be read."""

import math
from dataclasses import replace

import pytest
import torch

from tests.bundle.bundle_oracles import jacobian_of, weighted_residuals
from torchrefrac.bundle import (
    BundleOptions,
    BundleProblem,
    BundleState,
    CenterPrior,
    Determination,
    Expectations,
    GravityPrior,
    HeightPrior,
    Links,
    Observations,
    ScaleBars,
    adjust,
    determinations,
)
from torchrefrac.bundle.gauge import similarity_motions
from torchrefrac.bundle.layout import Layout
from torchrefrac.bundle.observability import UNITS, USEFUL, WORDS, unseen
from torchrefrac.camera import Intrinsics

SIGMA = 0.3
OPTIONS = BundleOptions(loss="squared", pixel_sigma=SIGMA)
ONE = torch.ones(1, dtype=torch.float64)
WATER = ("index_ratio", "plane_tilt", "plane_height")
LENS = ("focal", "principal_point", "distortion")


def _told(planted, **changes):
    """By name."""
    problem = planted.problem(**changes)
    return {told.name: told for told in determinations(problem, planted.truth, SIGMA)}


def _height(truth, sigma, image=1):
    return HeightPrior(torch.tensor([image]), truth.center[image : image + 1, 2], sigma * ONE)


def _bar(truth, sigma):
    length = (truth.points[4] - truth.points[9]).norm()[None]
    return ScaleBars(torch.tensor([4]), torch.tensor([9]), length, sigma * ONE)


def _centers(truth, *images, sigma=1.0):
    index = torch.tensor(images)
    information = torch.eye(3, dtype=torch.float64).expand(len(index), 3, 3) / sigma**2
    return CenterPrior(index, truth.center[index], information)


def test_the_index_ratio_is_seen_through_water(plant, disturb):
    planted = plant(cameras=5, points=40, noise=SIGMA)
    start = replace(disturb(planted.truth, size=0.2), index_ratio=torch.tensor(1.30, dtype=torch.float64))

    report = planted.adjusted(start, refine=("index_ratio",), terms=[planted.gravity])

    told = _told(planted)["index_ratio"]
    assert report.held == {}
    assert told.posterior < 0.02
    assert abs(report.state.index_ratio - planted.truth.index_ratio) < 3.0 * told.posterior
    assert report.state.index_ratio != 1.30


def test_over_land_alone_it_is_not_and_the_adjustment_holds_it_and_says_so(plant, disturb):
    planted = plant(cameras=5, points=20, land=20)
    start = disturb(planted.truth, size=0.2)

    report = planted.adjusted(start, refine=WATER, pixel_sigma=SIGMA)

    assert report.held == {
        "index_ratio": "index ratio: not determined",
        "plane_tilt": "tilt of the water to the cameras: not determined",
        "plane_height": "height of cameras above the water, relative: not determined",
    }
    assert report.problem.layout.water == ()
    assert torch.equal(report.state.index_ratio, start.index_ratio)
    assert all(map(torch.equal, report.state.planes, start.planes))
    assert report.costs[-1] < 1e-10


def test_what_is_not_seen_is_refined_where_this_is_asked_for(plant, disturb):
    planted = plant(cameras=5, points=20, land=20)

    report = planted.adjusted(disturb(planted.truth, size=0.2), refine=("index_ratio", "focal"), refine_unseen=True)

    assert report.held == {}
    assert (report.problem.layout.lens, report.problem.layout.water) == (("focal",), ("index_ratio",))


def test_what_is_not_seen_but_expected_is_refined_and_stays_as_expected(plant, disturb):
    planted = plant(cameras=5, points=20, land=20)
    start = disturb(planted.truth, size=0.2)
    expected = Expectations(index_ratio=0.01)

    report = planted.adjusted(start, refine=("index_ratio",), expected=expected)

    assert report.held == {}
    assert report.problem.layout.water == ("index_ratio",)
    torch.testing.assert_close(report.state.index_ratio, start.index_ratio, rtol=0.0, atol=1e-12)
    told = _told(planted, refine=("index_ratio",), expected=expected)["index_ratio"]
    assert told.posterior == pytest.approx(0.01, rel=1e-3)
    assert told.sentence == "index ratio: determined to 0.01, which is what was known before"


def test_only_what_the_data_do_not_determine_is_held(plant, disturb):
    planted = plant(cameras=5, points=30, land=30)

    report = planted.adjusted(disturb(planted.truth, size=0.1), refine=("focal", "index_ratio"))

    assert set(report.held) == {"index_ratio"}
    assert report.problem.layout.lens == ("focal",)


@pytest.mark.parametrize(
    ("name", "unit"), [("focal", "focal length, relative"), ("principal_point", "principal point")]
)
@pytest.mark.parametrize("many", [1, 200], ids=["100 observations", "20000 observations"])
def test_the_lens_of_level_cameras_in_air_is_not_determined(draw, name, unit, many):
    """Stretching the scene along the view, or shearing it, makes up for it."""
    start, seen = _nadir(draw, points=20 * many)

    report = adjust(start, seen, replace(OPTIONS, refine=(name,)))

    assert report.held == {name: f"{unit}: not determined"}
    assert torch.equal(report.state.lens.focal, start.lens.focal)
    assert torch.equal(report.state.lens.principal_point, start.lens.principal_point)


def test_tilted_cameras_determine_it(plant):
    told = _told(plant(cameras=5, points=40, index_ratio=1.0), refine=LENS)

    assert 0.0 < told["focal"].posterior < 0.05
    assert 0.0 < told["principal_point"].posterior < 50.0
    assert 0.0 < told["distortion"].posterior < math.inf


@pytest.mark.parametrize("planes", [1, 2])
def test_water_and_lens_are_as_well_determined_as_dense_algebra_says(plant, planes):
    """The covariance under the constraint that the cameras as a whole neither shift nor turn nor grow; a shift counts
    over the height above the water."""
    planted = plant(cameras=5, points=40, planes=planes)
    truth = planted.truth
    layout = Layout.create(truth, planted.links, ("focal", *WATER))
    problem = BundleProblem.create(truth, layout, planted.observations, OPTIONS)

    told = {d.name: d for d in determinations(problem, truth, SIGMA)}

    jacobian = jacobian_of(weighted_residuals(problem, planted.observations, truth), layout, truth)
    border = torch.zeros(jacobian.shape[1], 7, dtype=torch.float64)
    height = (truth.planes[0][planted.links.plane] * truth.center).sum(-1) - truth.planes[1][planted.links.plane]
    counts = torch.tensor((1.0, 1.0, 1.0, *3 * (1.0 / height.mean(),)), dtype=torch.float64).repeat(5)[:, None]
    border[:30] = counts.square() * similarity_motions(truth, layout)[0][:30]
    covariance = SIGMA**2 * _bordered_inverse(jacobian, border)
    sigma = covariance.diagonal().sqrt()
    by_height = jacobian_of(
        lambda state: _mean_heights(replace(state, center=truth.center), planted.links), layout, truth
    )
    above = (by_height @ covariance @ by_height.T).diagonal().sqrt()
    by_plane = sigma[layout.plane_columns(torch.arange(planes))]
    assert told["index_ratio"].posterior == pytest.approx(float(sigma[layout.index_column()]), rel=1e-3)
    assert told["focal"].posterior == pytest.approx(float(sigma[30]), rel=1e-3)
    assert told["plane_tilt"].posterior == pytest.approx(math.degrees(by_plane[:, :2].max()), rel=1e-3)
    assert told["plane_height"].posterior == pytest.approx(float(above.max() / height.mean()), rel=1e-3)
    assert told["scale"].posterior == math.inf


@pytest.mark.parametrize("fixed", ["position, gravity and length", "seven unknowns held"])
def test_what_fixes_the_gauge_and_no_more_changes_nothing_about_water_and_lens(plant, fixed):
    planted = plant(cameras=5, points=40)
    truth = planted.truth
    free = _told(planted, refine=("focal",))

    if fixed == "seven unknowns held":
        held = torch.zeros(5, 6, dtype=torch.bool)
        held[0] = held[3, 4] = True
        told = _told(planted, refine=("focal",), held=held)
    else:
        gravity = GravityPrior(planted.down_in_cam[2:3], 0.3, torch.tensor([2]))
        told = _told(planted, refine=("focal",), terms=[_centers(truth, 1), gravity, _bar(truth, 2.0)])

    for name in ("index_ratio", "plane_tilt", "plane_height", "focal"):
        assert told[name].posterior == pytest.approx(free[name].posterior, rel=1e-4)


def test_where_the_scene_lies_and_how_large_it_is_changes_nothing(plant):
    planted = plant(cameras=5, points=40)
    shift = torch.tensor((3000.0, -8000.0, 0.0), dtype=torch.float64)
    truth = planted.truth
    other = replace(planted, truth=replace(truth, center=10 * truth.center + shift, points=10 * truth.points + shift))

    here, there = (_told(p, terms=[_height(p.truth, s)]) for p, s in ((planted, 0.4), (other, 4.0)))

    for name in here:
        assert there[name].posterior == pytest.approx(here[name].posterior, rel=1e-3)


@pytest.mark.parametrize("where", [0.0, 5000.0])
def test_without_a_length_the_scale_is_not_determined(plant, where):
    planted = _shifted(plant(cameras=5, points=40), where)

    for terms in ([], [planted.gravity], [_centers(planted.truth, 1)], [_centers(planted.truth, 1), planted.gravity]):
        told = _told(planted, terms=terms)["scale"]
        assert told.posterior == math.inf
        assert told.sentence == "scale, relative: not determined"


@pytest.mark.parametrize("where", [0.0, 5000.0])
def test_with_one_it_is_as_well_as_the_length_is_known(plant, where):
    planted = _shifted(plant(cameras=5, points=40), where)
    truth = planted.truth
    length = float((truth.points[4] - truth.points[9]).norm())
    problems = {
        0.5 / float(truth.center[1, 2]): [_height(truth, 0.5)],
        1.5 / length: [_bar(truth, 1.5)],
        1.2 / length: [planted.gravity, _centers(truth, 1), _bar(truth, 1.2)],
        0.7 / float((truth.center[0] - truth.center[4]).norm()) * 2.0**0.5: [_centers(truth, 0, 4, sigma=0.7)],
    }

    for sigma, terms in problems.items():
        told = {d.name: d for d in determinations(planted.problem(terms=terms), truth, 1e-3)}["scale"]
        assert told.posterior == pytest.approx(sigma, rel=0.02)


def test_two_lengths_determine_the_scale_better_than_one(plant):
    planted = plant(cameras=5, points=40)
    bar, length = _bar(planted.truth, 1.0), float((planted.truth.points[4] - planted.truth.points[9]).norm())

    told = {d.name: d for d in determinations(planted.problem(terms=[bar, bar]), planted.truth, 1e-3)}["scale"]

    assert told.posterior == pytest.approx(0.5**0.5 / length, rel=0.02)


@pytest.mark.parametrize("refined", [(), WATER], ids=["held", "refined"])
def test_what_was_known_before_counts_whether_or_not_it_is_refined(plant, refined):
    planted = plant(cameras=5, points=20)
    expected = Expectations(index_ratio=1e-4, plane_tilt_deg=1e-3, plane_height=1e-3)

    told = _told(planted, refine=refined, expected=expected)

    height = float(planted.truth.center[:, 2].mean())
    assert told["index_ratio"].posterior == pytest.approx(1e-4, rel=0.02)
    assert (told["index_ratio"].prior, told["plane_height"].prior) == (1e-4, pytest.approx(1e-3 / height))
    assert told["plane_tilt"].prior == pytest.approx(1e-3)
    assert all(d.useful for d in told.values())


def test_at_an_index_ratio_of_exactly_one_there_is_no_plane_to_be_seen(plant):
    planted = plant(cameras=5, points=30, index_ratio=1.0)

    told = _told(planted, refine=WATER)

    assert told["index_ratio"].posterior < 0.05
    assert told["plane_tilt"].posterior == told["plane_height"].posterior == math.inf
    report = planted.adjusted(planted.truth, refine=WATER)
    assert set(report.held) == {"plane_tilt", "plane_height"}
    assert report.state.index_ratio == pytest.approx(1.0, abs=1e-6)


def test_nothing_is_asked_of_what_is_not_refined(plant):
    planted = plant(cameras=5, points=20, land=20)

    assert unseen(planted.problem(), planted.truth, SIGMA) == {}
    assert list(_told(planted)) == [*WATER, "scale"]
    assert list(_told(planted, refine=("radial", "focal"))) == ["focal", "radial", *WATER, "scale"]


def test_where_not_even_the_cameras_are_determined_nothing_is_held(plant):
    planted = plant(cameras=5, points=20)
    alone = planted.without(planted.observations.camera == 3).problem(terms=[planted.gravity], refine=("index_ratio",))

    assert unseen(alone, planted.truth, SIGMA) == {}


def test_every_determination_reads_as_one_short_sentence_with_its_unit():
    assert set(USEFUL) < set(WORDS)
    for name in WORDS:
        for posterior in (math.inf, 0.0, 1.2345e-7, 0.0123, 123.4):
            for prior in (None, 1e-9, 0.0246):
                told = Determination(name, posterior, prior)
                assert len(told.sentence) <= 100
                assert told.sentence.startswith(WORDS[name] + ": ")
                if not math.isinf(posterior):
                    assert f"{posterior:.2g}{UNITS.get(name, '')}" in told.sentence


def test_a_sentence_says_what_was_gained():
    assert Determination("plane_tilt", 0.02, 0.5).sentence == (
        "tilt of the water to the cameras: determined to 0.02 degrees (known to 0.5 degrees before)"
    )
    assert Determination("principal_point", 3.0).sentence == "principal point: determined to 3 px"
    assert Determination("index_ratio", 0.0099, 0.01).sentence.endswith("which is what was known before")


@pytest.mark.parametrize("name", USEFUL)
def test_useful_is_what_is_determined_well_enough_or_was_known_before(name):
    assert Determination(name, 0.99 * USEFUL[name]).useful
    assert not Determination(name, 1.01 * USEFUL[name]).useful
    assert not Determination(name, math.inf).useful
    assert Determination(name, math.inf, 1.0).useful


def _mean_heights(state, links):
    """Of the cameras of each plane above it."""
    normal, offset = state.planes
    above = (normal[links.plane] * state.center).sum(dim=-1) - offset[links.plane]
    return torch.stack([above[links.plane == plane].mean() for plane in range(len(offset))])


def _shifted(planted, x):
    shift = torch.tensor((x, 0.5 * x, 0.0), dtype=torch.float64)
    truth = planted.truth
    return replace(planted, truth=replace(truth, center=truth.center + shift, points=truth.points + shift))


def _nadir(draw, points):
    """Five cameras that look straight down from several heights, in air, and all pixels of some points."""
    turn = torch.diag(torch.tensor((1.0, -1.0, -1.0), dtype=torch.float64)).expand(5, 3, 3)
    center = torch.cat((draw.uniform(-30.0, 30.0, 5, 2), draw.uniform(30.0, 40.0, 5, 1)), dim=-1)
    below = torch.cat((draw.uniform(-40.0, 40.0, points, 2), draw.uniform(-100.0, -20.0, points, 1)), dim=-1)
    lens = Intrinsics.create(1024, 768, 667.0)
    state = BundleState(turn, center, below, lens, torch.tensor(1.0, dtype=torch.float64))
    camera, point = torch.arange(5).repeat(points), torch.arange(points).repeat_interleave(5)
    pixels, valid = state.cameras(Links.single(state), camera).project(below[point])
    assert valid.all()
    return state, Observations(camera, point, pixels + 0.1 * draw.normal(*pixels.shape))


def _bordered_inverse(jacobian, border):
    """Of [H C; C^T 0]."""
    unit = jacobian.norm(dim=0).clamp(min=1e-300)
    scaled, border = jacobian / unit, torch.linalg.qr(border / unit[:, None]).Q
    count = border.shape[1]
    upper = torch.cat((scaled.T @ scaled, border), dim=1)
    lower = torch.cat((border.T, torch.zeros(count, count, dtype=torch.float64)), dim=1)
    return torch.linalg.inv(torch.cat((upper, lower)))[: len(unit), : len(unit)] / unit[:, None] / unit
