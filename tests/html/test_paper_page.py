"""paper.html: the paper's numbers beside those of planted runs, and its figures in files."""

import pytest
import torch

from tests.html.html_runs import Planted
from tests.html.test_html_report import Page
from torchrefrac.files.run import RunRecord
from torchrefrac.html import write_paper
from torchrefrac.html.paper_numbers import PAPER, explained, verdict

ERRORS = {"none": 2.957, "radial": 2.5, "bundler": 1.6085, "refractive": 0.004}


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Both scenes with three models, the tank also with Bundler's cameras."""
    planted = Planted(tmp_path_factory.mktemp("sweep"), torch.Generator().manual_seed(3))
    made = [
        planted.complete(f"tank_{model}", model, scene="tank", camera_rms_cm=error) for model, error in ERRORS.items()
    ]
    return [*made, *(planted.complete(f"cans_{model}", model, scene="cans") for model in PAPER)]


@pytest.fixture(scope="module")
def page(runs):
    folder = runs[0].parent
    return Page(write_paper(folder, runs).read_text(encoding="utf-8"))


def test_it_sets_the_paper_s_numbers_beside_ours(page):
    for number in ("1.062", "0.717", "0.025", "2.5", "1.61"):
        assert number in page.text
    assert "that explains 50 % of the difference" in page.text
    assert "with refraction at the water surface, exactly" in page.text
    assert "What is missing" not in page.text


def test_it_holds_four_figures_each_of_which_lies_beside_it_as_png_and_pdf(page, runs):
    folder = runs[0].parent
    files = [f"paper_figure{number}.{kind}" for number in (1, 3, 5, 6) for kind in ("png", "pdf")]

    assert all(reference.startswith("data:") for reference in page.references)
    assert [link for link in page.links if link.startswith("paper_")] == files
    for name in files:
        assert (folder / name).read_bytes().startswith(b"\x89PNG" if name.endswith("png") else b"%PDF"), name
    assert len(page.images) == 4
    assert all(image["alt"] for image in page.images)


def test_what_has_no_run_is_left_out_and_named(runs, tmp_path):
    found = Page(write_paper(tmp_path, [run for run in runs if run.name == "cans_none"]).read_text(encoding="utf-8"))

    assert "There is no complete run of tank, No refraction; tank, Radial distortion; tank, Refraction" in found.text
    assert "Table 1." not in found.text
    assert "Figure 5." in found.text
    assert "Figure 1." not in found.text


@pytest.mark.parametrize(
    ("radial", "bundler", "words"),
    [(2.717, 1.717, "50 %"), (2.717, 0.5, "100 %"), (2.717, 3.0, "nothing"), (0.6, 0.5, "nothing")],
)
def test_what_bundler_s_cameras_explain_is_their_share_of_the_difference(tmp_path, radial, bundler, words):
    assert f"explains {words} of" in explained(_records(tmp_path, radial=radial, bundler=bundler))


def test_refraction_is_compared_by_how_many_times_it_is_better(tmp_path):
    assert "100 times as much" in verdict(_records(tmp_path, none=2.0, refractive=0.02))
    assert "42 times" in verdict(_records(tmp_path, none=2.0, refractive=0.02))
    assert explained(_records(tmp_path, none=2.0, refractive=0.02)) == ""
    assert "no runs" in verdict(_records(tmp_path, radial=1.0))


def _records(folder, **errors):
    return {
        ("tank", model): RunRecord.of(folder, {"status": "complete", "model": model, "camera_rms_cm": error})
        for model, error in errors.items()
    }
