"""Many problems at once have the results that each has alone."""

from dataclasses import fields, replace

import pytest
import torch

from torchrefrac.ransac import RansacOptions, RelativePoseEstimator, RelativePoseEstimators, ransac, ransac_each
from torchrefrac.refinement import TwoViews

OPTIONS = RansacOptions(max_error=2.0)


def _views(make_problem):
    """Pairs of all sizes and kinds, with wrong matches alone, too few, and more than are screened."""
    kinds = [
        {"points": 700, "noise": 0.5, "outliers": 200, "gravity_error_deg": 1.0},
        {"points": 90, "noise": 0.5, "outliers": 89, "gravity_error_deg": 0.5},
        {"points": 30, "noise": 0.3, "outliers": 5, "gravity_error_deg": 0.3},
        {"points": 9, "noise": 0.3},
        {"points": 300, "noise": 0.3, "outliers": 60, "gravity_error_deg": 0.0},
    ]
    return [make_problem("relative", **kind)[0].data for kind in kinds]


def _generators(count):
    return [torch.Generator().manual_seed(seed) for seed in range(count)]


@pytest.mark.parametrize("known_heading", [False, True], ids=["heading free", "heading known"])
def test_reports_are_those_of_each_pair_alone(make_problem, known_heading):
    views = _views(make_problem)
    if known_heading:
        views = [replace(one, known_heading=0.1 * i) for i, one in enumerate(views)]

    together = ransac_each(RelativePoseEstimators(views), OPTIONS, _generators(5))
    alone = [
        ransac(RelativePoseEstimator(one), OPTIONS, generator)
        for one, generator in zip(views, _generators(5), strict=True)
    ]

    assert {report.status for report in alone} >= {"too_few_data", "no_consensus"}
    for one, other in zip(together, alone, strict=True):
        assert (one.status, one.num_samples, one.detail) == (other.status, other.num_samples, other.detail)
        assert torch.equal(one.inliers, other.inliers)
        torch.testing.assert_close(one.model, other.model, rtol=1e-7, atol=1e-9)


def test_a_pair_has_the_same_result_whatever_the_others_are(make_problem):
    views = _views(make_problem)

    first, third = (
        ransac_each(RelativePoseEstimators(some), OPTIONS, [torch.Generator().manual_seed(3) for _ in some])[0]
        for some in ([views[0], *views], views[:1])
    )

    assert first.num_samples == third.num_samples
    torch.testing.assert_close(first.model, third.model, rtol=1e-7, atol=1e-9)


def test_views_of_each_model_have_the_errors_and_costs_of_each_pair_alone(make_problem, draw):
    views = [one for one in _views(make_problem) if len(one) > 20]
    models = torch.stack(
        [torch.cat((0.01 * draw.normal(4), 0.3 * draw.normal(1), draw.normal(2), 30.0 + draw.normal(1))) for _ in views]
    )
    table = _together(views)
    limits = torch.tensor([3.0, 40.0, 9.0, 200.0]).double()
    active = torch.ones(len(views), len(table), dtype=torch.bool)

    errors, costs = table.squared_errors(models), table.costs(models, limits)
    quadratic = table.linearize(models, limits, active)
    refined = table.refine(models, limits, 5).states

    for i, one in enumerate(views):
        model, count, limit = models[i : i + 1], len(one), float(limits[i])
        torch.testing.assert_close(errors[i, :count], one.squared_errors(model)[0], rtol=1e-9, atol=1e-9)
        assert errors[i, count:].isinf().all()
        torch.testing.assert_close(costs[i : i + 1], one.costs(model, limit), rtol=1e-9, atol=1e-9)
        expected = one.linearize(model, limit, active[:1, :count])
        for name in quadratic._fields:
            wanted = getattr(expected, name)[0]
            torch.testing.assert_close(
                getattr(quadratic, name)[i], wanted, rtol=1e-8, atol=1e-6 * float(wanted.abs().max())
            )
        torch.testing.assert_close(refined[i], one.refine(model, limit, 5).states[0], rtol=1e-6, atol=1e-8)


def _together(views):
    width = max(map(len, views))

    def filled(planes):
        return torch.cat((planes, planes.new_zeros(width - len(planes), 2)))

    first = views[0]
    assert {f.name for f in fields(TwoViews)} > {"plane1", "exists"}
    return replace(
        first,
        plane1=torch.stack([filled(one.plane1) for one in views]),
        plane2=torch.stack([filled(one.plane2) for one in views]),
        cam_from_level=torch.stack([one.cam_from_level for one in views]),
        focal=torch.stack([one.focal.expand(2, 2) for one in views]),
        gravity_sigma=torch.tensor([one.gravity_sigma for one in views]).double(),
        exists=torch.arange(width) < torch.tensor([len(one) for one in views])[:, None],
    )
