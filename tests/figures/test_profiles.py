"""Sections across a surface."""

import pytest
import torch

from tests.files.rasters import raster_of
from torchrefrac.figures.profiles import draw_profiles, profiles


@pytest.fixture
def valley():
    """60 m from east to west and 30 m across; its bed is a parabola of y, 4 m below the water in the middle."""
    y = 15.0 - 0.25 - 0.5 * torch.arange(60, dtype=torch.float64)
    height = (0.02 * y.square() - 4.0)[:, None].expand(60, 120).clone()
    return raster_of(height, x_west=100.0, y_north=15.0, cell_size=0.5)


def test_three_sections_run_across_the_longer_side(valley):
    found = profiles(valley)

    assert [profile.name for profile in found] == ["A", "B", "C"]
    for profile, x in zip(found, (115.0, 130.0, 145.0), strict=True):
        assert profile.start == (pytest.approx(x, abs=0.5), pytest.approx(-14.75))
        assert profile.end == (pytest.approx(x, abs=0.5), pytest.approx(14.75))
        y = -14.75 + profile.distance
        assert torch.allclose(profile.height, 0.02 * y.square() - 4.0, atol=0.02 * 15.0 * 0.5)


def test_where_there_is_no_surface_a_section_has_none(valley):
    hole = valley.valid.clone()
    hole[28:32] = False
    holed = raster_of(valley.height, hole, x_west=100.0, y_north=15.0, cell_size=0.5)

    (profile, *_) = profiles(holed)

    assert bool(profile.height[(profile.distance - 14.75).abs() < 0.5].isnan().all())
    assert bool(profile.height[:20].isfinite().all())


@pytest.mark.parametrize("shape", [(0, 0), (1, 1), (1, 2), (2, 1), (40, 3)])
def test_any_surface_is_drawn_or_has_nothing_to_cut(tmp_path, shape):
    drawn = draw_profiles(raster_of(torch.zeros(shape, dtype=torch.float64)), tmp_path / "profiles.png")

    assert drawn == (tmp_path / "profiles.png").is_file()


def test_a_picture_is_written(tmp_path, valley):
    assert draw_profiles(valley, tmp_path / "profiles.png")
    assert (tmp_path / "profiles.png").stat().st_size > 10_000
