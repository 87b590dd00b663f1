"""The same pose on a GPU as on the CPU."""

from dataclasses import fields, replace

import pytest
import torch

from torchrefrac.ransac import AbsolutePoseEstimator, RansacOptions, RelativePoseEstimator, ransac

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device"),
]


@pytest.mark.parametrize("kind", ["relative", "absolute"])
def test_the_pose_and_its_inliers_are_those_of_the_cpu(make_problem, kind):
    estimator, _, _, _ = make_problem(kind, points=700, noise=0.5, outliers=300, gravity_error_deg=1.0)
    options = RansacOptions(max_error=2.0)

    here = ransac(estimator, options, torch.Generator().manual_seed(7))
    there = ransac(_on_gpu(estimator), options, torch.Generator().manual_seed(7))

    assert there.model.is_cuda
    torch.testing.assert_close(there.model.cpu(), here.model, rtol=1e-4, atol=1e-4)
    assert (there.inliers.cpu() != here.inliers).sum() <= 2


def _on_gpu(estimator):
    data = estimator.data
    values = {f.name: getattr(data, f.name) for f in fields(data)}
    moved = replace(data, **{k: v.cuda() for k, v in values.items() if isinstance(v, torch.Tensor)})
    return (RelativePoseEstimator if isinstance(estimator, RelativePoseEstimator) else AbsolutePoseEstimator)(moved)
