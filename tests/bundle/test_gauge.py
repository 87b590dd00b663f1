"""What no image can tell: 4 freedoms above a known water, 7 in air, fewer with every measurement that notices them."""

from dataclasses import replace

import pytest
import torch

from tests.bundle.bundle_oracles import dense_system, jacobian_of, null_space_of, projector, weighted_residuals
from tests.bundle.changes import changed
from tests.tolerances import assert_matches
from torchrefrac.bundle import (
    BundleProblem,
    CenterPrior,
    Expectations,
    HeightPrior,
    KnownPoints,
    ScaleBars,
    Waterline,
)
from torchrefrac.bundle.gauge import gauge_directions
from torchrefrac.geometry import heading_rotation, so3_exp
from torchrefrac.optim import Step
from torchrefrac.scene import Interfaces
from torchrefrac.scene.interfaces import PORT

in_water_and_air = pytest.mark.parametrize(("index_ratio", "freedoms"), [(1.333, 4), (1.0, 7)], ids=["water", "air"])
WATER, AIR = 1.333, 1.0
ONE = torch.ones(1, dtype=torch.float64)


def _centers(truth, *images):
    index = torch.tensor(images)
    return CenterPrior(index, truth.views.center[index], torch.eye(3, dtype=torch.float64).expand(len(index), 3, 3))


def _points(truth, *points):
    index = torch.tensor(points)
    return KnownPoints(index, truth.points[index], torch.eye(3, dtype=torch.float64).expand(len(index), 3, 3))


def _height(truth):
    return HeightPrior(torch.tensor([1]), truth.views.center[1:2, 2], ONE)


def _bar(truth):
    return ScaleBars(torch.tensor([8]), torch.tensor([9]), (truth.points[8] - truth.points[9]).norm()[None], ONE)


def _shore(truth):
    """Points 0 and 1 are on the water."""
    return Waterline(torch.tensor((0, 1)), torch.zeros(2, dtype=torch.long), torch.ones(2, dtype=torch.float64))


BOTH = ("plane_tilt", "plane_height")
CASES = {
    "a known water": (WATER, 4, {}),
    "a known water and free intrinsics": (WATER, 4, {"refine": ("focal", "radial")}),
    "a known water and a free index": (WATER, 4, {"refine": ("index_ratio",)}),
    "a known water and gravity": (WATER, 4, {"gravity": True}),
    "a height above the water": (WATER, 3, {"terms": [_height]}),
    "a bar through water": (WATER, 3, {"terms": [_bar]}),
    "a shore on a known water": (WATER, 4, {"terms": [_shore]}),
    "one centre above water": (WATER, 1, {"terms": [lambda t: _centers(t, 2)]}),
    "two centres above water": (WATER, 0, {"terms": [lambda t: _centers(t, 2, 0)]}),
    "one known point under water": (WATER, 1, {"terms": [lambda t: _points(t, 9)]}),
    "one known point on the shore": (WATER, 2, {"terms": [lambda t: _points(t, 0)]}),
    "two known points under water": (WATER, 0, {"terms": [lambda t: _points(t, 9, 8)]}),
    "a bar and a centre": (WATER, 1, {"terms": [_bar, lambda t: _centers(t, 2)]}),
    "a fixed camera above water": (WATER, 0, {"fixed": (slice(0, 1), slice(None))}),
    "a fixed centre above water": (WATER, 1, {"fixed": (slice(1, 2), slice(3, 6))}),
    "a fixed height above water": (WATER, 3, {"fixed": (slice(1, 2), slice(5, 6))}),
    "fixed rotations above water": (WATER, 3, {"fixed": (slice(None), slice(0, 3))}),
    "a free water": (WATER, 7, {"refine": BOTH}),
    "a free water and a free index": (WATER, 7, {"refine": ("index_ratio", *BOTH)}),
    "a free water and gravity": (WATER, 5, {"refine": BOTH, "gravity": True}),
    "a free water, gravity and a height": (WATER, 4, {"refine": BOTH, "gravity": True, "terms": [_height]}),
    "a free water, gravity and a bar": (WATER, 4, {"refine": BOTH, "gravity": True, "terms": [_bar]}),
    "a free water and two centres": (WATER, 1, {"refine": BOTH, "terms": [lambda t: _centers(t, 0, 2)]}),
    "a free water and three points": (WATER, 0, {"refine": BOTH, "terms": [lambda t: _points(t, 9, 8, 4)]}),
    "a free water and a shore": (WATER, 7, {"refine": BOTH, "terms": [_shore]}),
    "a free water of which something is expected": (
        WATER,
        4,
        {"refine": BOTH, "expected": Expectations(plane_tilt_deg=1.0, plane_height=1.0)},
    ),
    "a free level": (WATER, 5, {"refine": ("plane_height",)}),
    "a free tilt about the origin": (WATER, 6, {"refine": ("plane_tilt",)}),
    "two free levels": (WATER, 5, {"refine": ("plane_height",), "levels": 2}),
    "two known levels": (WATER, 3, {"levels": 2}),
    "two free waters": (WATER, 7, {"refine": BOTH, "levels": 2}),
    "a wall of known glass": (WATER, 3, {"glass": 1.0}),
    "a wall of glass of any thickness": (WATER, 4, {"glass": 1.0, "refine": ("layer_thickness",)}),
    "a wall of glass of any index": (WATER, 3, {"glass": 1.0, "refine": ("layer_index",)}),
    "a free wall of known glass": (WATER, 6, {"glass": 1.0, "refine": BOTH}),
    "a free wall of any glass": (WATER, 7, {"glass": 1.0, "refine": ("layer_index", "layer_thickness", *BOTH)}),
    "a known port": (WATER, 6, {"port": True}),
    "a known port of glass": (WATER, 6, {"port": True, "glass": 1.0}),
    "a known port and gravity": (WATER, 4, {"port": True, "gravity": True}),
    "a port that is tilted anyhow": (WATER, 6, {"port": True, "refine": ("plane_tilt",)}),
    "a port at any distance": (WATER, 7, {"port": True, "refine": BOTH}),
    "a port of known glass at any distance": (WATER, 6, {"port": True, "glass": 1.0, "refine": BOTH}),
    "a port of any glass at any distance": (
        WATER,
        7,
        {"port": True, "glass": 1.0, "refine": ("layer_thickness", *BOTH)},
    ),
    "a bar through a port": (WATER, 6, {"port": True, "terms": [_bar]}),
    "a bar through a port at any distance": (WATER, 6, {"port": True, "refine": BOTH, "terms": [_bar]}),
    "air": (AIR, 7, {}),
    "air and free intrinsics": (AIR, 7, {"refine": ("focal", "radial")}),
    "air and gravity": (AIR, 5, {"gravity": True}),
    "a bar in air": (AIR, 6, {"terms": [_bar]}),
    "one centre in air": (AIR, 4, {"terms": [lambda t: _centers(t, 2)]}),
    "two centres in air": (AIR, 1, {"terms": [lambda t: _centers(t, 2, 0)]}),
    "three centres in air": (AIR, 0, {"terms": [lambda t: _centers(t, 2, 0, 1)]}),
    "one known point in air": (AIR, 4, {"terms": [lambda t: _points(t, 9)]}),
    "three known points in air": (AIR, 0, {"terms": [lambda t: _points(t, 9, 8, 4)]}),
    "a fixed camera in air": (AIR, 1, {"fixed": (slice(0, 1), slice(None))}),
    "a height in air": (AIR, 6, {"terms": [_height]}),
}


@pytest.fixture
def case_of(plant):
    """`case_of(name)`: the planted scene of CASES, and its problem. Two of its points lie on the water."""

    def make(name):
        index_ratio, _, options = CASES[name]
        options = dict(options)
        planted = plant(views=5, points=14, index_ratio=index_ratio)
        planted = _with(planted, 2, *(options.pop(name, None) for name in ("levels", "glass", "port")))
        terms = [term(planted.truth) for term in options.pop("terms", [])]
        terms += [planted.gravity] if options.pop("gravity", False) else []
        fixed = torch.zeros(5, 6, dtype=torch.bool)
        if "fixed" in options:
            fixed[options.pop("fixed")] = True
        return planted, planted.problem(terms=terms, fixed=fixed, **options)

    return make


@pytest.mark.parametrize("name", CASES)
def test_the_gauge_is_the_null_space_of_all_derivatives_at_a_perfect_state(case_of, name):
    planted, problem = case_of(name)
    layout, freedoms = problem.layout, CASES[name][1]

    gauge = problem.linearize(planted.truth).system.null_space

    residuals = weighted_residuals(problem, planted.observations, planted.truth)
    null = null_space_of(jacobian_of(residuals, layout, planted.truth))
    assert (0 if gauge is None else gauge.shape[1]) == freedoms == null.shape[1]
    if gauge is not None:
        actual, expected = projector(gauge, layout.size), projector(null[: layout.size], layout.size)
        torch.testing.assert_close(actual, expected, rtol=0.0, atol=1e-6)


@pytest.mark.parametrize("name", ["a known water", "a free water and gravity", "air", "a bar in air"])
def test_the_directions_are_orthonormal(case_of, name):
    planted, problem = case_of(name)

    gauge = problem.linearize(planted.truth).system.null_space

    assert_matches(gauge.T @ gauge, torch.eye(gauge.shape[1], dtype=torch.float64), slack=10.0)


@pytest.mark.parametrize("name", CASES)
def test_away_from_the_minimum_too_the_points_can_follow_so_that_the_cost_is_flat(case_of, disturb, name):
    """To first order, wherever the measurements themselves notice nothing."""
    planted, problem = case_of(name)
    state, known = disturb(planted.truth, size=0.3), replace(problem.options, expected=Expectations())
    problem = BundleProblem.create(planted.seen_in(state), problem.layout, known, problem.terms)

    system = problem.linearize(state).system

    matrix, gradient = dense_system(system)
    if system.null_space is not None:
        size = problem.layout.size
        followed = -torch.linalg.solve(matrix[size:, size:], matrix[size:, :size] @ system.null_space)
        whole = torch.cat((system.null_space, followed))
        scale = matrix.diagonal().sqrt() @ whole.abs()
        assert ((matrix @ whole) / matrix.diagonal().sqrt().clamp(min=1e-300)[:, None] / scale).abs().amax() < 1e-8
        assert ((gradient @ whole) / (gradient.abs() @ whole.abs())).abs().amax() < 1e-8


def test_shared_unknowns_of_the_cameras_take_no_part_in_the_gauge(plant):
    planted = plant(cameras=2)

    gauge = gauge_directions(planted.truth, planted.layout(("focal", "distortion")))

    assert gauge.shape == (6 * 4 + 2 * 6, 4)
    assert (gauge[24:] == 0.0).all()


@pytest.mark.parametrize("name", [name for name, (_, _, options) in CASES.items() if "fixed" in options])
def test_what_is_fixed_takes_no_part_in_the_gauge_to_the_last_bit(case_of, name):
    planted, problem = case_of(name)

    gauge = problem.linearize(planted.truth).system.null_space

    if gauge is not None:
        fixed = problem.layout.fixed.flatten().nonzero()[:, 0]
        assert (gauge[fixed] == 0.0).all()


@pytest.mark.parametrize("move", ["x", "y", "heading", "scale"])
def test_moving_cameras_and_points_together_costs_nothing_however_far(plant, disturb, move):
    planted = plant(noise=1.0, land=4)
    problem = planted.problem(terms=[planted.gravity], loss="huber")
    state = disturb(planted.truth)

    turn = heading_rotation(torch.tensor(2.0 if move == "heading" else 0.0, dtype=torch.float64))
    shift = torch.tensor((70.0 * (move == "x"), -30.0 * (move == "y"), 0.0), dtype=torch.float64)
    moved = _moved(state, turn, shift, 3.0 if move == "scale" else 1.0)

    assert_matches(problem.linearize(moved).cost, problem.linearize(state).cost, slack=100.0)


@pytest.mark.parametrize("move", ["z", "tilt"])
def test_through_water_lifting_or_tilting_the_scene_is_seen(plant, move):
    planted = plant()
    tilt = torch.tensor((0.1 if move == "tilt" else 0.0, 0.0, 0.0), dtype=torch.float64)
    shift = torch.tensor((0.0, 0.0, 1.0 if move == "z" else 0.0), dtype=torch.float64)

    moved = _moved(planted.truth, so3_exp(tilt), shift, 1.0)

    assert planted.problem().linearize(moved).cost > 1.0


@in_water_and_air
def test_along_the_gauge_the_cost_grows_with_the_fourth_power_of_the_step(plant, index_ratio, freedoms):
    planted = plant(views=3, points=10, index_ratio=index_ratio)
    problem = planted.problem()
    system = problem.linearize(planted.truth).system
    matrix, _ = dense_system(system)
    size = problem.layout.size

    assert system.null_space.shape[1] == freedoms
    for direction in system.null_space.T:
        points = -torch.linalg.solve(matrix[size:, size:], matrix[size:, :size] @ direction).view(-1, 3)
        costs = []
        for length in (1e-2, 2e-2):
            step = Step(length * direction, length * points, torch.zeros(()), torch.tensor(True))
            costs.append(float(problem.linearize(problem.retract(planted.truth, step)).cost))
        assert costs[0] < 1e-6
        assert costs[1] < 17.0 * costs[0] + 1e-15


@in_water_and_air
def test_a_step_does_not_drift_along_the_gauge(plant, disturb, index_ratio, freedoms):
    planted = plant(noise=0.5, index_ratio=index_ratio)
    state = disturb(planted.truth, size=0.2)

    linearized = planted.problem().linearize(state)
    step = linearized.solve(1e-6)

    assert step.solved
    assert linearized.system.null_space.shape[-1] == freedoms
    assert (linearized.system.null_space.T @ step.reduced).norm() < 1e-3 * step.reduced.norm()


def _moved(state, turn, shift, scale):
    return changed(
        state,
        rotation=state.views.rotation @ turn.T,
        center=scale * state.views.center @ turn.T + shift,
        points=scale * state.points @ turn.T + shift,
    )


def _with(planted, shore, levels=None, glass=None, port=None):
    """The first points put on the water, and the water of the last cameras two centimetres higher; through glass of
    this thickness, or through ports."""
    points = planted.truth.points.clone()
    points[:shore, 2] = 0.0
    water = planted.truth.interfaces
    levels = levels or 1
    normal, ratio = water.normal.expand(levels, 3), water.index_ratio.expand(levels)
    interfaces = Interfaces(normal, water.offset + 2.0 * torch.arange(levels), ratio)
    if port:
        ahead = torch.tensor([[0.03, -0.02, -1.0]], dtype=torch.float64)
        ahead = torch.nn.functional.normalize(ahead, dim=-1)
        interfaces = Interfaces(ahead, torch.full_like(ratio, -2.0), ratio, kinds=(PORT,))
    if glass:
        thickness = torch.full_like(ratio, glass)[:, None]
        interfaces = replace(interfaces, layers=torch.full_like(thickness, 1.52), thickness=thickness)
    views = replace(planted.truth.views, interface=torch.arange(5) % levels)
    truth = replace(planted.truth, views=views, interfaces=interfaces, points=points)
    seen = planted.observations
    pixels, valid = truth.camera_of(seen.view).project(points[seen.point])
    assert valid.all()
    return replace(planted, truth=truth, observations=replace(seen, pixels=pixels))
