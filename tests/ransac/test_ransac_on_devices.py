"""The same poses on other devices as on the CPU."""

from collections import Counter
from collections.abc import Sequence

import pytest
import torch

from tests.made_device import LOOKS, SIZES, UPLOADS, on_every_device, waits
from tests.ransac.test_many_problems import MANY, relative_and_absolute
from torchrefrac.numerics import on_device
from torchrefrac.ransac import RansacOptions, RansacReport, ransac, ransac_each

OPTIONS = RansacOptions(max_error=2.0)


@on_every_device
@relative_and_absolute
def test_the_pose_and_its_inliers_are_those_of_the_cpu(make_problem, kind, device):
    estimator, _, _, _ = make_problem(kind, points=700, noise=0.5, outliers=300, gravity_error_deg=1.0)

    here = ransac(estimator, OPTIONS, _generator(7))
    there = ransac(type(estimator)(on_device(estimator.data, device)), OPTIONS, _generator(7))

    assert there.model.device.type == there.inliers.device.type == device
    _assert_same([there], [here], device)


@on_every_device
@pytest.mark.parametrize("known_heading", [False, True], ids=["heading free", "heading known"])
@relative_and_absolute
def test_poses_of_many_problems_are_those_of_the_cpu(make_problem, kind, known_heading, device):
    data = _problems(make_problem, kind, known_heading)

    here, there = (
        ransac_each(MANY[kind](some), OPTIONS, [_generator(i) for i in range(len(data))])
        for some in (data, on_device(data, device))
    )

    assert [report.status for report in here] == ["success", "success", "no_consensus"]
    assert {report.model.device.type for report in there} == {device}
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


@relative_and_absolute
def test_a_batch_of_samples_waits_for_as_much_however_many_problems_it_is_of(make_problem, kind):
    one_batch = RansacOptions(max_error=2.0, batch_size=64, max_samples=64)
    data = on_device([make_problem(kind, noise=0.5, outliers=20)[0].data for _ in range(4)], "made")
    found = []
    for some in (data[:1], data):
        watched = Watched(MANY[kind](some))
        for problem in range(len(some)):
            watched.is_promising(problem)
        with waits() as counted:
            reports = ransac_each(watched, one_batch, [_generator(seed) for seed in range(len(some))])
        assert [report.status for report in reports] == ["success"] * len(some)
        found.append(counted - watched.inside)

    in_batch, at_last = Counter({LOOKS: 2, UPLOADS: 3, SIZES: 3}), Counter({LOOKS: 2, UPLOADS: 1, SIZES: 1})
    assert found[0] == found[1] == in_batch + at_last


def _problems(make_problem, kind, known_heading):
    """Two whose data agree, and one whose data do not."""
    shared = {"noise": 0.5, "gravity_error_deg": 1.0, "known_heading": known_heading}
    sizes = [(700, 300), (200, 20), (300, 300)]
    return [make_problem(kind, points=n, outliers=bad, **shared)[0].data for n, bad in sizes]


def _generator(seed):
    return torch.Generator().manual_seed(seed)


def _assert_same(there: Sequence[RansacReport], here: Sequence[RansacReport], device: str) -> None:
    """A GPU rounds in another way."""
    tolerance, most = (1e-10, 0) if device == "made" else (1e-4, 2)
    for one, other in zip(there, here, strict=True):
        assert one.status == other.status
        torch.testing.assert_close(one.model.cpu(), other.model, rtol=tolerance, atol=tolerance)
        assert (one.inliers.cpu() != other.inliers).sum() <= most
