"""What the terminal says of a finished run."""

import pytest

from torchrefrac.record.summary import reconstruction_lines

METRICS = {
    "registered_images": 7, "images": 8, "points": 4985, "points_above_water": 128, "points_outside_water": 1437,
    "reprojection_median_px": 0.11, "seconds_total": 80.0, "gravity": "measured", "length_unit": "cm",
}  # fmt: skip


def test_points_outside_the_water_are_told_apart():
    lines = reconstruction_lines(METRICS)
    assert "3420 points under water, 128 above its level, 1437 below it, but outside the water" in lines


@pytest.mark.parametrize("metrics", [{}, {"points_outside_water": 0}], ids=["of before", "none"])
def test_where_there_are_none_nothing_is_said_of_them(metrics):
    known = {name: value for name, value in METRICS.items() if name != "points_outside_water"}
    assert not any("outside" in line for line in reconstruction_lines(known | metrics))
