"""report.html: what it says, that it holds everything it shows, and that it is made of whatever there is."""

import json
import re
from html.parser import HTMLParser
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from tests.html.html_runs import LOST, Planted
from torchrefrac.files.run import RunRecord
from torchrefrac.html import write_report, write_sweep_report
from torchrefrac.html.words import rounded, seconds, verdict, with_sigma

MEGABYTES = 1e6


class Page(HTMLParser):
    """What a page refers to, and its text."""

    def __init__(self, page):
        super().__init__()
        self.page, self.references, self.links, self.ids, self.images = page, [], [], [], []
        self.words = []
        self.feed(page)

    def handle_starttag(self, tag, attributes):
        found = dict(attributes)
        for name in ("src", "href", "srcset", "data", "poster", "action"):
            if name in found:
                (self.links if tag == "a" else self.references).append(found[name])
        if "id" in found:
            self.ids.append(found["id"])
        if tag == "img":
            self.images.append(found)

    def handle_data(self, data):
        self.words.append(data)

    @property
    def text(self):
        return " ".join(" ".join(self.words).split())


@pytest.fixture(scope="module")
def planted(tmp_path_factory):
    return Planted(tmp_path_factory.mktemp("runs"), torch.Generator().manual_seed(7))


@pytest.fixture(scope="module")
def told(planted):
    """The run of three models whose report was written, with the others beside it."""
    runs = [planted.complete(name, name) for name in ("none", "radial", "refractive")]
    write_report(runs[2], runs)
    return runs[2]


@pytest.fixture(scope="module")
def page(told):
    return Page((told / "report.html").read_text(encoding="utf-8"))


def test_the_verdict_is_one_sentence_of_what_matters():
    metrics = {
        "status": "complete", "registered_images": 12, "images": 12, "camera_rms_cm": 0.0072345, "model": "refractive",
        "index_ratio": 1.32996, "index_ratio_sigma": 0.000213, "true_index_ratio": 1.33,
    }  # fmt: skip

    assert verdict(RunRecord.of(Path(), metrics), "cm") == (
        "12 of 12 photographs placed; cameras within 0.0072 cm of the truth (RMS); "
        "index ratio 1.3300 ± 0.0002 (true 1.33)."
    )


@pytest.mark.parametrize(
    ("metrics", "sentence"),
    [
        (
            {"status": "failed", "reason": "no pair of images has 20 matches.", "stages": ["features", "matching"]},
            "Failed after features and matching: no pair of images has 20 matches.",
        ),
        (
            {"status": "interrupted", "reason": "stopped by the user"},
            "Interrupted before the first stage was complete: stopped by the user.",
        ),
        ({}, "Nothing is known about this run."),
    ],
)
def test_a_run_that_did_not_finish_says_how_far_it_got_and_why_it_ended(metrics, sentence):
    assert verdict(RunRecord.of(Path(), metrics), "") == sentence


@pytest.mark.parametrize(
    ("value", "words"),
    [(0.0072345, "0.0072"), (123.4, "123"), (0.0, "0"), (None, "-"), (float("nan"), "-"), (1.26e-9, "1.3e-09")],
)
def test_numbers_have_the_digits_that_mean_something(value, words):
    assert rounded(value) == words


@pytest.mark.parametrize(
    ("sigma", "words"), [(0.000213, "1.3300 ± 0.0002"), (0.00014, "1.32996 ± 0.00014"), (0.5, "1.3 ± 0.5")]
)
def test_an_estimate_has_the_digits_that_its_error_leaves(sigma, words):
    assert with_sigma(1.32996, sigma) == words


@pytest.mark.parametrize(("value", "words"), [(3.14, "3.1 s"), (83.0, "1 min 23 s"), (7384.0, "2 h 03 min")])
def test_durations_are_said_in_units_of_their_size(value, words):
    assert seconds(value) == words


def test_the_page_says_what_went_in_and_what_came_out(page):
    for words in (
        "tank_small: Refraction", "7 of 8 photographs placed", "0.012 cm", "model=refractive", "640 \u00d7 480 pixels",
        "1 min 10 s", "1.2 GiB", "determined to 0.00032", "focal: not determined by these photographs",
        "Figure 1. The scene from the side", "Figure 2. The path of the camera", "Figure 3. Attitude",
        "Residuals by angle", "How far the water moves things", "no longer than",
    ):  # fmt: skip
        assert words in page.text, words


def test_models_stand_side_by_side_with_links_to_their_own_reports(page, told):
    assert [link for link in page.links if link.endswith("report.html")] == [
        "../none/report.html", "../radial/report.html",
    ]  # fmt: skip
    assert "No refraction" in page.text


def test_an_image_that_was_not_placed_says_why_and_its_text_is_no_markup(page):
    assert f"not placed: {LOST}" in page.text
    assert LOST not in page.page
    assert "<refractive>" in page.text
    assert "<refractive>" not in page.page


def test_the_page_needs_no_other_file_and_no_network(page):
    assert page.images
    assert all(reference.startswith("data:") for reference in page.references)
    assert all(re.fullmatch(r"[\w./-]+", link) and not link.startswith("/") for link in page.links)
    assert not re.search(r"url\(|@import|<script|<iframe|<object", page.page)
    assert len(page.ids) == len(set(page.ids))


def test_figures_are_numbered_in_their_order(page):
    numbers = [int(number) for number in re.findall(r"<h3>Figure (\d+)\. ", page.page)]

    assert len(numbers) >= 5
    assert numbers == list(range(1, len(numbers) + 1))


def test_every_column_is_explained(page):
    tables = re.findall(r"<thead>(.*?)</thead>.*?</div>\s*<p class=\"soft terms\">(.*?)</p>", page.page, re.DOTALL)

    assert len(tables) == page.page.count("<table>") == 2
    for heads, terms in tables:
        names = [head.partition(" (")[0] for head in re.findall(r"<th[^>]*>([^<]+)</th>", heads)]
        assert not [name for name in names[1:] if f"{name[0].upper()}{name[1:]}</em>" not in terms]


def test_links_lead_to_files_of_the_run(page, told):
    own = [link for link in page.links if not link.endswith("report.html")]

    assert {"metrics.json", "cameras.json", "points.ply"} <= set(own)
    assert all((told / link).is_file() for link in own)


def test_every_picture_says_what_it_shows(page):
    assert all(image["alt"] for image in page.images)
    assert '<html lang="en">' in page.page
    assert "<title>tank_small: Refraction</title>" in page.page


def test_a_report_takes_few_megabytes(told):
    assert (told / "report.html").stat().st_size < 3 * MEGABYTES


def test_a_failed_run_gets_a_report_of_how_far_it_got(planted):
    run = planted.ended("failed", status="failed", reason="the photographs overlap too little", model="none", scene="x")
    (run / "run.log").write_text("first\n<last>\n")

    page = Page(write_report(run).read_text(encoding="utf-8"))

    assert "Failed before the first stage was complete: the photographs overlap too little." in page.text
    assert "<last>" in page.text
    assert "Table 1" not in page.text


@pytest.mark.parametrize("content", [None, "{", "[]", "{}"])
def test_even_a_folder_without_usable_metrics_gets_a_report(tmp_path, content):
    if content is not None:
        (tmp_path / "metrics.json").write_text(content)

    page = Page(write_report(tmp_path).read_text(encoding="utf-8"))

    assert "Nothing is known about this run." in page.text


@pytest.mark.parametrize("name", ["cameras.json", "tracks.npz"])
def test_a_damaged_file_is_named_and_the_rest_is_told(planted, name):
    run = planted.complete(f"damaged_{name}")
    (run / name).write_text('{"images": 3')

    page = Page(write_report(run).read_text(encoding="utf-8"))

    assert "7 of 8 photographs placed" in page.text
    assert "The cameras and points cannot be read" in page.text
    assert "The path of the camera" not in page.text


def test_an_old_run_whose_photographs_are_gone_has_what_it_can(planted, tmp_path):
    run = planted.complete("old", capture=str(tmp_path / "nowhere"))
    (run / "tracks.npz").unlink()
    cameras = json.loads((run / "cameras.json").read_text())
    for image in cameras["images"]:
        image.pop("center_covariance", None)
    (run / "cameras.json").write_text(json.dumps(cameras))

    page = Page(write_report(run).read_text(encoding="utf-8"))

    assert f"The photographs are not in {tmp_path / 'nowhere'} any more" in page.text
    assert "The path of the camera" in page.text
    assert "Attitude of the cameras" not in page.text
    assert "Residuals" not in page.text
    assert "How well the cameras are determined" not in page.text


@pytest.fixture(scope="module")
def sweep(planted, told):
    """The page of a sweep of three complete jobs, one that failed, one whose metrics are damaged, and its summary."""
    folder = told.parent
    failed = planted.ended(
        "3_failed", status="failed", reason="water.index_ratio is abc & no number", model="none", scene="tank_small",
        overrides={"scene": "tank_small", "water.index_ratio": "abc"},
    )  # fmt: skip
    damaged = folder / "4_damaged"
    damaged.mkdir()
    (damaged / "metrics.json").write_text("{")
    for name in ("summary.png", "dense_figure1.png", "dense_error_map.png"):
        cv2.imwrite(str(folder / name), np.full((40, 60, 3), 200, dtype=np.uint8))
    runs = [folder / name for name in ("none", "radial", "refractive")]
    return Page(write_sweep_report(folder, [*runs, failed, damaged]).read_text(encoding="utf-8"))


def test_a_sweep_tells_of_failed_jobs_first(sweep):
    text = sweep.text
    assert "3 of 5 jobs are complete; 2 failed or did not finish." in text
    assert text.index("water.index_ratio is abc & no number") < text.index("What was compared")
    assert "metrics.json is damaged" in text


def test_a_sweep_has_a_table_and_a_figure_of_each_scene_and_links_to_the_jobs(sweep):
    assert "Figure 2. The scene from the side" in sweep.text
    assert sweep.links[0] == "refractive/report.html"
    assert all(reference.startswith("data:") for reference in sweep.references)


def test_a_sweep_has_its_summary_and_the_dense_surfaces_side_by_side(sweep):
    figures = re.findall(r"Figure \d+\. [\w ]+", sweep.page)

    assert figures == [
        "Figure 1. All jobs at one glance", "Figure 2. The scene from the side", "Figure 3. The dense surface",
        "Figure 4. Distance of the dense points from the true planes",
    ]  # fmt: skip


def test_a_sweep_of_failures_alone_has_a_report(planted, tmp_path):
    failed = planted.ended("alone", status="failed", reason="no images", model="none")

    page = Page(write_sweep_report(tmp_path, [failed]).read_text(encoding="utf-8"))

    assert "0 of 1 jobs are complete" in page.text
    assert "no images" in page.text


def test_check_points_and_levels_of_a_survey_stand_in_tables(planted):
    row = {"name": "check1", "dx": 0.0123, "dy": -0.004, "dz": 0.02, "distance": 0.0238, "sigma": [0.005, 0.006, 0.011]}
    level = {"source": "gauge bridge", "height": 430.981, "sigma": 0.01, "weight_percent": 71.3}
    about = {"check_points": [row], "check_rms_xy_cm": 0.0129, "check_rms_z_cm": 0.02, "water_level_from": [level]}

    page = write_report(planted.complete("surveyed", **about)).read_text()

    cells = re.findall(r"<t[dh][^>]*>([^<]*)</t[dh]>", page)
    at = cells.index("check1")
    assert cells[at + 1 : at + 6] == ["0.0123", "-0.004", "0.02", "0.0238", "0.005, 0.006, 0.011"]
    at = cells.index("gauge bridge")
    assert cells[at + 1 : at + 3] == ["430.981 ± 0.010", "71.3 %"]
    assert "Ground control points" not in page
