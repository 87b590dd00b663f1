"""What matches agree on where OpenCV's newer estimators end in an error, as they do for some data."""

import cv2
import pytest
import torch

from torchrefrac.geometry import so3_exp
from torchrefrac.sfm.pinhole import essential_pose, fundamental_consensus


@pytest.fixture
def failing(monkeypatch):
    """OpenCV, but for its newer estimators."""
    for name in ("findFundamentalMat", "findEssentialMat"):
        found = getattr(cv2, name)

        def fails(*given, found=found):
            if any(isinstance(one, int) and one == cv2.USAC_DEFAULT for one in given):
                raise cv2.error("(-215:Assertion failed) !model.empty()")
            return found(*given)

        monkeypatch.setattr(cv2, name, fails)


@pytest.fixture
def planes(draw):
    """Ideal coordinates (60, 2) of points in two views; the last ten are wrong in the second."""
    points = draw.uniform(-1.0, 1.0, 60, 3) + torch.tensor((0.0, 0.0, 5.0)).double()
    turned = (points - torch.tensor((0.5, 0.1, 0.0)).double()) @ so3_exp(torch.tensor((0.02, -0.05, 0.1)).double()).T
    first, second = (seen[:, :2] / seen[:, 2:] for seen in (points, turned))
    second[50:] = draw.uniform(-0.3, 0.3, 10, 2)
    return first, second


def test_plain_ransac_decides_on_the_epipolar_geometry(failing, planes):
    agree = fundamental_consensus(*(1000.0 * plane + 500.0 for plane in planes), 1.0)

    assert set(range(50)) <= set(agree.tolist())
    assert len(agree) < 56


def test_plain_ransac_decides_on_the_pose(failing, planes):
    found = essential_pose(*planes, cv2.USAC_DEFAULT, 0.9999, 1e-3)

    assert found is not None
    assert bool(found[2][:50].all())
    direction = found[1] / found[1].norm()
    expected = -so3_exp(torch.tensor((0.02, -0.05, 0.1)).double()) @ torch.tensor((0.5, 0.1, 0.0)).double()
    assert float((direction * expected / expected.norm()).sum()) > 0.9999
