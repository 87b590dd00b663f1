"""What a report says of a survey, against the metrics that it is made from."""

from dataclasses import replace
from pathlib import Path

import pytest

from tests.files.two_cameras import two_camera_scene
from torchrefrac.files.run import RunRecord
from torchrefrac.html.contents import RunContents
from torchrefrac.html.survey import methods, order_table, survey_facts
from torchrefrac.scene import Georeference

METRICS = {
    "model": "refractive", "registered_images": 22, "dense_points": 5000, "water_level_m": 430.9967,
    "water_level_sigma_m": 0.0168, "bed_area_m2": 1464.8, "gsd_m": 0.0247, "depth_median_m": 2.568,
    "depth_99_percent_m": 2.978, "bed_sigma_median_m": 0.0181, "s44_exclusive_percent": 99.98,
    "s44_special_percent": 100.0, "s44_1_percent": 100.0, "s44_2_percent": 100.0, "position_rms_m": 0.0275,
    "position_rms_vertical_m": 0.0323,
}  # fmt: skip


@pytest.fixture
def run(draw):
    scene = replace(two_camera_scene(draw), length_unit="m", georeference=Georeference("EPSG:32633", (0.0, 0.0, 431.0)))
    return RunContents(RunRecord.of(Path("run"), METRICS), scene=scene)


def test_facts_have_units_and_no_more_digits_than_mean_something(run):
    facts = dict(survey_facts(run))

    assert facts["reference system"] == "EPSG:32633"
    assert facts["level of the water"] == "430.997 \u00b1 0.017 m"
    assert facts["area of the bed"] == "1465 m\u00b2"
    assert facts["depth"] == "2.57 m in the median, 99 % at most 2.98 m"
    assert facts["vertical uncertainty of the bed"] == "0.018 m, or 0.035 m at 95 % (median)"


def test_the_slope_of_a_river_stands_with_its_sigma(run):
    slopes = {"water_slope_east_mm_per_m": 1.8345, "water_slope_east_sigma_mm_per_m": 0.412}
    slopes |= {"water_slope_north_mm_per_m": -0.92, "water_slope_north_sigma_mm_per_m": 0.38}

    facts = dict(survey_facts(replace(run, record=RunRecord.of(Path("run"), METRICS | slopes))))

    assert facts["the water rises by"] == "1.8 \u00b1 0.4 mm/m to the east, -0.9 \u00b1 0.4 mm/m to the north"


def test_orders_stand_from_the_strictest_on(run):
    table = order_table(run)

    assert [[cell.text for cell in row] for row in table.rows] == [
        ["exclusive", "0.15 m", "0.0075", "99.98 %"],
        ["special", "0.25 m", "0.0075", "100 %"],
        ["1a and 1b", "0.5 m", "0.013", "100 %"],
        ["2", "1 m", "0.023", "100 %"],
    ]


def test_the_methods_paragraph_has_the_numbers_of_the_run(run):
    words = methods(run)

    assert words.startswith("22 photographs were reconstructed with refraction")
    assert "(5000 points)" in words
    assert "estimated as 430.997 \u00b1 0.017 m" in words
    assert "0.028 m horizontally and 0.032 m vertically" in words


def test_of_a_run_that_is_no_survey_nothing_is_said(draw):
    plain = RunContents(RunRecord.of(Path("run"), {"model": "none"}), scene=two_camera_scene(draw))

    assert survey_facts(plain) == []
    assert order_table(plain) is None
    assert methods(plain) == ""
