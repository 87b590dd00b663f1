"""What the terminal says of a finished run."""

import pytest

from torchrefrac.record.summary import reconstruction_lines

METRICS = {
    "registered_images": 7, "images": 8, "points": 4985, "points_above_water": 128, "points_outside_water": 1437,
    "reprojection_median_px": 0.11, "seconds_total": 80.0, "gravity": "measured", "length_unit": "cm",
}  # fmt: skip


def test_check_points_and_what_decided_the_level_are_told():
    of_points = {"check_points": [{}, {}], "check_rms_xy_m": 0.012, "check_rms_z_m": 0.0171}
    of_water = {
        "water_levels_m": {"may": {"height": 431.0, "sigma": 0.01}},
        "water_level_from": [{"source": "gauge", "weight_percent": 75.0}, {"source": "images", "weight_percent": 25.0}],
    }

    lines = reconstruction_lines(METRICS | of_points | of_water)

    assert "2 check points meet 0.012 m (xy) and 0.0171 m (z) RMS from where they are stated" in lines
    assert "water of may: 431 m +- 0.01" in lines
    assert "level of the water from gauge 75 %, images 25 %" in lines


def test_the_slope_of_the_water_is_told():
    of_slope = {"water_slope_east_mm_per_m": 1.834, "water_slope_east_sigma_mm_per_m": 0.41}
    of_slope |= {"water_slope_north_mm_per_m": -0.92, "water_slope_north_sigma_mm_per_m": 1.3}

    lines = reconstruction_lines(METRICS | of_slope)

    assert "the water rises by 1.83 +- 0.41 mm/m to the east, -0.92 +- 1.3 mm/m to the north" in lines


def test_points_outside_the_water_are_told_apart():
    lines = reconstruction_lines(METRICS)
    assert "3420 points under water, 128 above its level, 1437 below it, but outside the water" in lines


@pytest.mark.parametrize("metrics", [{}, {"points_outside_water": 0}], ids=["of before", "none"])
def test_where_there_are_none_nothing_is_said_of_them(metrics):
    known = {name: value for name, value in METRICS.items() if name != "points_outside_water"}
    assert not any("outside" in line for line in reconstruction_lines(known | metrics))


def test_what_is_found_of_walls_and_ports_is_told():
    of_wall = {"interface": "wall", "wall_upright_off_deg": 0.123, "wall_upright_sigma_deg": 0.41}
    of_port = {
        "interface": "port", "port_distance_cm": 2.013, "port_distance_sigma_cm": 0.04,
        "port_tilt_deg": 1.02, "port_tilt_sigma_deg": 0.02,
    }  # fmt: skip

    wall, port = (reconstruction_lines(METRICS | metrics) for metrics in (of_wall, of_port))

    assert "by gravity the wall is 0.12 degrees from upright (+- 0.41)" in wall
    assert "3420 points under water, 128 before the glass, 1437 behind it, but outside the water" in wall
    assert "port found 2.013 cm ahead (+- 0.04), tilted by 1.02 degrees (+- 0.02)" in port
