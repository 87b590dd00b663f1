"""The scale of stated camera heights, some of which are wrong."""

import pytest
import torch

from torchrefrac.sfm.heights import fit_heights

FOUND = torch.tensor([3.0, 4.0, 3.1, 4.2, 3.3, 4.1], dtype=torch.float64)


def test_heights_that_agree_give_the_least_squares_scale(draw):
    stated = 10.0 * FOUND * (1.0 + 0.01 * draw.normal(6))
    fit = fit_heights(FOUND, stated, 0.01 * stated)
    assert float(fit.scale) == float((FOUND * stated).sum() / (FOUND * FOUND).sum())
    assert float(fit.offset) == 0.0
    assert fit.agrees.all()


@pytest.mark.parametrize("times", [10.0, 0.1, 1.2])
def test_a_height_that_is_wrong_has_no_part_in_the_scale(draw, times):
    stated = 10.0 * FOUND * (1.0 + 0.003 * draw.normal(6))
    stated[2] *= times
    fit = fit_heights(FOUND, stated, 0.01 * stated)
    assert float(fit.scale) == pytest.approx(10.0, rel=0.005)
    assert fit.agrees.tolist() == [True, True, False, True, True, True]


@pytest.mark.parametrize("offset", [20.0, -15.0])
def test_heights_from_another_level_than_the_water_give_scale_and_offset(draw, offset):
    stated = 10.0 * FOUND + offset
    fit = fit_heights(FOUND, stated, 0.01 * stated)
    assert float(fit.scale) == pytest.approx(10.0, rel=1e-9)
    assert float(fit.offset) == pytest.approx(offset, rel=1e-9)
    assert fit.agrees.all()


def test_two_heights_that_differ_are_no_offset():
    stated = torch.tensor([30.0, 80.0], dtype=torch.float64)
    fit = fit_heights(FOUND[:2], stated, 0.01 * stated)
    assert float(fit.offset) == 0.0


def test_flights_at_one_height_show_no_offset():
    fit = fit_heights(torch.full((5,), 3.0).double(), torch.full((5,), 50.0).double(), torch.full((5,), 0.5).double())
    assert float(fit.offset) == 0.0
    assert fit.agrees.all()


def test_heights_agree_within_the_sigma_that_is_stated():
    stated = 10.0 * FOUND * torch.tensor([1.0, 1.05, 1.0, 0.95, 1.0, 1.0], dtype=torch.float64)
    assert fit_heights(FOUND, stated, 0.05 * stated).agrees.all()
    assert fit_heights(FOUND, stated, 0.001 * stated).agrees.tolist() == [True, False, True, False, True, True]
