"""The same poses on other devices as on the CPU."""

from collections import Counter
from collections.abc import Sequence

import pytest
import torch

from tests.made_device import LOOKS, SIZES, UPLOADS, on_every_device, waits
from torchrefrac.numerics import on_device
from torchrefrac.ransac import RansacOptions, RansacReport, RelativePoseEstimators, ransac, ransac_each

OPTIONS = RansacOptions(max_error=2.0)


@on_every_device
@pytest.mark.parametrize("kind", ["relative", "absolute"])
def test_the_pose_and_its_inliers_are_those_of_the_cpu(make_problem, kind, device):
    estimator, _, _, _ = make_problem(kind, points=700, noise=0.5, outliers=300, gravity_error_deg=1.0)

    here = ransac(estimator, OPTIONS, _generator(7))
    there = ransac(type(estimator)(on_device(estimator.data, device)), OPTIONS, _generator(7))

    assert there.model.device.type == there.inliers.device.type == device
    _assert_same([there], [here], device)


@on_every_device
@pytest.mark.parametrize("known_heading", [False, True])
def test_poses_of_many_pairs_are_those_of_the_cpu(make_problem, known_heading, device):
    views = _pairs(make_problem, known_heading)

    here = ransac_each(RelativePoseEstimators(views), OPTIONS, [_generator(i) for i in range(len(views))])
    there = ransac_each(
        RelativePoseEstimators(on_device(views, device)), OPTIONS, [_generator(i) for i in range(len(views))]
    )

    assert [report.status for report in here] == ["success", "success", "no_consensus"]
    _assert_same(there, here, device)


class Watched:
    """Estimators that keep for what the host waits in their optimisations."""

    def __init__(self, estimators):
        self.estimators, self.inside = estimators, Counter()

    def __getattr__(self, name):
        return getattr(self.estimators, name)

    def optimize(self, *data, **how):
        with waits() as counted:
            found = self.estimators.optimize(*data, **how)
        self.inside += counted
        return found


def test_a_batch_of_samples_waits_for_as_much_however_many_pairs_it_is_of(make_problem):
    one_batch = RansacOptions(max_error=2.0, batch_size=64, max_samples=64)
    views = on_device([make_problem("relative", noise=0.5, outliers=20)[0].data for _ in range(4)], "made")
    found = []
    for some in (views[:1], views):
        watched = Watched(RelativePoseEstimators(some))
        for problem in range(len(some)):
            watched.is_promising(problem)
        with waits() as counted:
            reports = ransac_each(watched, one_batch, [_generator(seed) for seed in range(len(some))])
        with waits() as at_last:
            for problem, report in enumerate(reports):
                watched.degeneracy(problem, report.model, report.inliers)
                report.num_inliers  # noqa: B018
        assert [report.status for report in reports] == ["success"] * len(some)
        found.append(counted - watched.inside - at_last)

    assert found[0] == found[1] == {LOOKS: 2, UPLOADS: 3, SIZES: 3}


def _pairs(make_problem, known_heading):
    """Two pairs whose matches agree, and one whose matches do not."""
    shared = {"noise": 0.5, "gravity_error_deg": 1.0, "known_heading": known_heading}
    sizes = [(700, 300), (200, 20), (300, 300)]
    return [make_problem("relative", points=n, outliers=bad, **shared)[0].data for n, bad in sizes]


def _generator(seed):
    return torch.Generator().manual_seed(seed)


def _assert_same(there: Sequence[RansacReport], here: Sequence[RansacReport], device: str) -> None:
    """A GPU rounds in another way."""
    tolerance, most = (1e-10, 0) if device == "made" else (1e-4, 2)
    for one, other in zip(there, here, strict=True):
        assert one.status == other.status
        torch.testing.assert_close(one.model.cpu(), other.model, rtol=tolerance, atol=tolerance)
        assert (one.inliers.cpu() != other.inliers).sum() <= most
