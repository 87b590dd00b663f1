"""Covariances of an adjusted scene: against dense algebra on derivatives by autograd, and against what errors do."""

from dataclasses import replace

import pytest
import torch
from bundle_oracles import jacobian_of, weighted_residuals
from scipy.integrate import quad

from torchrefrac.bundle import (
    CenterPrior,
    Expectations,
    GravityPrior,
    HeightPrior,
    KnownPoints,
    Observations,
    ScaleBars,
    Waterline,
    adjust,
    estimate_pixel_sigma,
    uncertainty,
)
from torchrefrac.bundle.layout import Layout
from torchrefrac.bundle.problem import BundleProblem
from torchrefrac.geometry import so3_log
from torchrefrac.optim import LevenbergMarquardtOptions, SingularError

SIGMA = 0.4
ONE = torch.ones(1, dtype=torch.float64)
WATER = ("index_ratio", "plane_tilt", "plane_height")


def _bar(truth):
    length = (truth.points[4] - truth.points[9]).norm()[None]
    return ScaleBars(torch.tensor([4]), torch.tensor([9]), length, 0.2 * ONE)


def _marks(truth):
    ids = torch.tensor((3, 1))
    return KnownPoints(ids, truth.points[ids], 4.0 * torch.eye(3, dtype=torch.float64).expand(2, 3, 3))


def _height(truth):
    return HeightPrior(torch.tensor([1]), truth.center[1:2, 2], 0.5 * ONE)


def _first_held(count):
    held = torch.zeros(count, 6, dtype=torch.bool)
    held[0] = held[2, 3:] = True
    return held


CASES = {
    "free": {},
    "air": {"index_ratio": 1.0},
    "a bar": {"terms": [_bar]},
    "marks and a bar": {"terms": [_marks, _bar]},
    "a height": {"terms": [_height]},
    "held cameras": {"held": True},
    "held cameras and a bar": {"held": True, "terms": [_bar]},
    "a free lens": {"refine": ("focal", "radial"), "lenses": 2, "expected": Expectations(focal=0.01)},
    "free water": {"refine": WATER},
    "two free waters": {"refine": ("focal", *WATER), "planes": 2, "terms": [_marks]},
}


@pytest.fixture
def case_of(plant):
    """`case_of(name)`: the planted scene of CASES, and its problem."""

    def make(name, **changes):
        options = dict(CASES[name])
        scene = {key: options.pop(key) for key in ("index_ratio", "lenses", "planes") if key in options}
        planted = plant(cameras=5, points=20, **scene)
        terms = [term(planted.truth) for term in options.pop("terms", [])] + [planted.gravity]
        held = _first_held(5) if options.pop("held", False) else None
        return planted, planted.problem(terms=terms, held=held, pixel_sigma=SIGMA, **options | changes)

    return make


@pytest.mark.parametrize("name", CASES)
def test_all_of_it_is_the_inverse_of_the_whole_matrix_of_derivatives(case_of, name):
    """Bordered by inner constraints on what is kept."""
    planted, problem = case_of(name)
    layout, truth = problem.layout, planted.truth

    told = uncertainty(problem, truth, SIGMA)

    jacobian = jacobian_of(weighted_residuals(problem, planted.observations, truth), layout, truth)
    expected = SIGMA**2 * _bordered_inverse(jacobian, problem.linearize(truth).system.null_space)
    size = layout.size
    _assert_same(told.covariance, expected[:size, :size])
    images = torch.arange(layout.num_cameras)
    poses = 6 * images[:, None] + torch.arange(6)
    _assert_same(told.pose, expected[poses[:, :, None], poses[:, None]])
    kept = torch.zeros(20, dtype=torch.bool) if layout.kept is None else layout.kept
    columns = torch.zeros(20, 3, dtype=torch.long)
    columns[~kept] = size + torch.arange(3 * int((~kept).sum())).view(-1, 3)
    columns[kept] = layout.first_kept + torch.arange(3 * int(kept.sum())).view(-1, 3)
    _assert_same(told.points, expected[columns[:, :, None], columns[:, None]])
    deviation = expected.diagonal().clamp(min=0.0).sqrt()
    for lens_name, found in told.lens.items():
        _assert_same(found, deviation[layout.lens_columns(lens_name, torch.arange(layout.num_lenses))])
    if layout.water:
        _assert_same(told.index_ratio, deviation[layout.index_column()])
        _assert_same(told.planes, deviation[layout.plane_columns(torch.arange(layout.num_planes))])


def test_a_known_sigma_scales_everything(case_of):
    _, problem = case_of("free water", refine=("focal", *WATER), expected=Expectations())
    problem = replace(problem, terms=())
    state = problem.layout.retract  # noqa: F841
    planted, problem = case_of("free water")
    problem = replace(problem, terms=())

    once, twice = (uncertainty(problem, planted.truth, sigma) for sigma in (SIGMA, 2.0 * SIGMA))

    assert (once.pixel_sigma, twice.pixel_sigma) == (SIGMA, 2.0 * SIGMA)
    _assert_same(twice.pose, 4.0 * once.pose)
    _assert_same(twice.points, 4.0 * once.points)
    _assert_same(twice.point_sigma, 2.0 * once.point_sigma)
    _assert_same(twice.index_ratio, 2.0 * once.index_ratio)
    _assert_same(twice.planes, 2.0 * once.planes)
    _assert_same(twice.covariance, 4.0 * once.covariance)
