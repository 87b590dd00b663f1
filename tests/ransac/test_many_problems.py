"""Many problems at once have the results that each has alone."""

from dataclasses import fields, replace

import pytest
import torch

from torchrefrac.camera import RefractiveCamera
from torchrefrac.ransac import (
    AbsolutePoseEstimator,
    AbsolutePoseEstimators,
    RansacOptions,
    RelativePoseEstimator,
    RelativePoseEstimators,
    ransac,
    ransac_each,
)
from torchrefrac.refinement import OneView, TwoViews
from torchrefrac.refraction import FlatInterface

OPTIONS = RansacOptions(max_error=2.0)
ONE = {"relative": RelativePoseEstimator, "absolute": AbsolutePoseEstimator}
MANY = {"relative": RelativePoseEstimators, "absolute": AbsolutePoseEstimators}
relative_and_absolute = pytest.mark.parametrize("kind", ["relative", "absolute"])


@pytest.fixture
def make_data(make_problem, make_degenerate, draw):
    """`make_data(kind)`: pairs or views of all sizes and kinds, with wrong data alone, too few or none, more than are
    screened, and those that do not determine a pose."""
    kinds = [
        {"points": 700, "noise": 0.5, "outliers": 200, "gravity_error_deg": 1.0},
        {"points": 90, "noise": 0.5, "outliers": 89, "gravity_error_deg": 0.5},
        {"points": 30, "noise": 0.3, "outliers": 5, "gravity_error_deg": 0.3},
        {"points": 9, "noise": 0.3},
        {"points": 300, "noise": 0.3, "outliers": 60, "gravity_error_deg": 0.0},
    ]

    def make_narrow():
        estimator, truth, _, basin = make_problem("absolute", points=50, gravity_error_deg=2.0)
        view = estimator.data
        rotation, center = view.poses(truth[None])
        camera = RefractiveCamera(basin.lens, rotation[0], center[0], FlatInterface(basin.index_ratio))
        points = basin.points[:1] + 0.15 * draw.normal(50, 3)
        return replace(view, points=points, plane=basin.lens.plane_from_pixels(camera.project(points)[0]))

    def make(kind):
        data = [make_problem(kind, **about)[0].data for about in kinds]
        data[3] = replace(data[3], focal=1.1 * data[3].focal)
        undetermined = make_degenerate("along", 0.3).data if kind == "relative" else make_narrow()
        return [*data, data[3].rows(torch.arange(0)), undetermined]

    return make


def _generators(count):
    return [torch.Generator().manual_seed(seed) for seed in range(count)]


@pytest.mark.parametrize("known_heading", [False, True], ids=["heading free", "heading known"])
@relative_and_absolute
def test_reports_are_those_of_each_problem_alone(make_data, kind, known_heading):
    data = make_data(kind)
    if known_heading:
        data = [replace(one, known_heading=0.1 * i) for i, one in enumerate(data)]

    together = ransac_each(MANY[kind](data), OPTIONS, _generators(7))
    alone = [ransac(ONE[kind](one), OPTIONS, draws) for one, draws in zip(data, _generators(7), strict=True)]

    assert {report.status for report in alone} >= {
        "too_few_data",
        "no_consensus",
        *(() if known_heading else ("degenerate",)),
    }
    for one, other in zip(together, alone, strict=True):
        assert (one.status, one.num_samples, one.detail) == (other.status, other.num_samples, other.detail)
        assert one.model.dtype == other.model.dtype
        assert torch.equal(one.inliers, other.inliers)
        torch.testing.assert_close(one.model, other.model, rtol=1e-12, atol=1e-12)


@relative_and_absolute
def test_a_problem_has_the_same_result_whatever_the_others_are(make_data, kind):
    data = make_data(kind)

    first, third = (
        ransac_each(MANY[kind](some), OPTIONS, [torch.Generator().manual_seed(3) for _ in some])[0]
        for some in ([data[0], *data], data[:1])
    )

    assert first.num_samples == third.num_samples
    torch.testing.assert_close(first.model, third.model, rtol=1e-12, atol=1e-12)


@relative_and_absolute
def test_headings_that_are_known_of_some_alone_are_refused(make_data, kind):
    data = make_data(kind)

    with pytest.raises(ValueError, match="known_heading must be stated for all problems or for none"):
        MANY[kind]([data[0], replace(data[0], known_heading=0.1)])


@relative_and_absolute
def test_data_of_each_model_have_the_errors_and_costs_of_each_problem_alone(make_data, draw, kind):
    data = [one for one in make_data(kind)[:5] if len(one) > 20]
    tilts = 4 if kind == "relative" else 2
    height = draw.uniform(29.0, 31.0, 1)
    models = [torch.cat((0.01 * draw.normal(tilts), 0.3 * draw.normal(1), draw.normal(2), height)) for _ in data]
    models = torch.stack(models)
    table = type(data[0]).together(data)
    limits = torch.tensor([3.0, 40.0, 9.0, 200.0]).double()
    active = torch.rand(len(data), len(table), generator=torch.Generator().manual_seed(1)) < 0.9

    errors, costs = table.squared_errors(models), table.costs(models, limits)
    quadratic = table.linearize(models, limits, active)
    refined = table.refine(models, limits, 5).states

    assert {f.name for f in fields(TwoViews)} & {f.name for f in fields(OneView)} > {"exists", "known_heading"}
    for i, one in enumerate(data):
        model, count, limit = models[i : i + 1], len(one), float(limits[i])
        torch.testing.assert_close(errors[i, :count], one.squared_errors(model)[0], rtol=1e-12, atol=1e-12)
        assert errors[i, count:].isinf().all()
        torch.testing.assert_close(costs[i : i + 1], one.costs(model, limit), rtol=1e-12, atol=1e-12)
        expected = one.linearize(model, limit, active[i : i + 1, :count])
        for name in quadratic._fields:
            wanted = getattr(expected, name)[0]
            torch.testing.assert_close(
                getattr(quadratic, name)[i], wanted, rtol=1e-12, atol=1e-12 * float(wanted.abs().max())
            )
        torch.testing.assert_close(refined[i], one.refine(model, limit, 5).states[0], rtol=1e-12, atol=1e-12)
