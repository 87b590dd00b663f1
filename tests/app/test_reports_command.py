"""report.html as each command leaves it: after a run, a failed one, `adjust` and `densify`; and how to do without."""

import json
import re
import shutil
from html.parser import HTMLParser

import pytest

from tests.planted_reconstructions import plant_reconstruction
from torchrefrac.files.colmap.model import write_colmap
from torchrefrac.files.run import PAGES

FIGURE = "data:image/"
QUICK = (
    "dense=depthmap", "dense.cell=24", "outputs.mesh=false", "outputs.raster=false", "outputs.depth_maps=false",
)  # fmt: skip


class Page(HTMLParser):
    """The text of a page, what it loads, and the files that it links to."""

    def __init__(self, path):
        super().__init__()
        self.loads, self.links, self._words = [], [], []
        self.page = path.read_text(encoding="utf-8")
        self.feed(self.page)

    def handle_starttag(self, tag, attributes):
        for name, value in attributes:
            if name in ("src", "href", "srcset", "data", "poster", "action"):
                (self.links if tag == "a" else self.loads).append(value)

    def handle_data(self, data):
        self._words.append(data)

    @property
    def text(self):
        return " ".join(" ".join(self._words).split())


@pytest.fixture
def report(tmp_path):
    """`report(folder)`: its report, once seen to need no other file, no network and no program."""

    def read(folder="run"):
        page = Page(tmp_path / folder / "report.html")
        assert all(load.startswith("data:") for load in page.loads)
        assert not re.search(r"https?://(?!www\.w3\.org/)|url\(|@import|<script|<iframe|<object", page.page)
        assert all((tmp_path / folder / link).is_file() for link in page.links if not link.startswith("#"))
        assert not {"nan", "None", "inf"} & set(page.text.split())
        return page

    return read


@pytest.fixture
def alignment(make_basin, draw, tmp_path):
    """Folder of a reconstruction that a pinhole made of what lies under water."""
    planted = plant_reconstruction(make_basin(cameras=6, points=150, seen_by=3), draw, noise=0.3)
    write_colmap(planted.as_of_a_pinhole(draw), tmp_path / "given")
    return tmp_path / "given"


def test_a_complete_run_is_told_with_its_numbers_and_figures(torchrefrac, sparse, known_sparse, report):
    ended = torchrefrac("scene=capture", f"scene.path={sparse / 'capture'}", "seed=0", "out=run", reports=True)

    assert (ended.status, ended.err.count("error")) == (0, 0)
    page = report()
    for words in (
        "3 of 3 photographs placed; cameras within ", "of the truth (RMS)", "index ratio 1.33", "Table 1. Errors",
        "320 \u00d7 240 pixels", "seed=0", "Figure 1", "Figure 2", "cam04.jpg", "run.log",
    ):  # fmt: skip
        assert words in page.text, words
    assert sum(load.startswith(FIGURE) for load in page.loads) >= 5
    assert {"metrics.json", "cameras.json", "points.ply", "run.log"} <= set(page.links)


def test_a_run_without_a_report_leaves_none_and_takes_away_that_of_before(torchrefrac, sparse, known_sparse, tmp_path):
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "report.html").write_text("of a run before")

    ended = torchrefrac(
        "scene=capture", f"scene.path={sparse / 'capture'}", "report=false", "out=run", reports=True
    )  # fmt: skip

    assert ended.status == 0
    assert (tmp_path / "run" / "metrics.json").is_file()
    assert not (tmp_path / "run" / "report.html").exists()


def test_a_failed_run_is_told_with_its_reason_and_the_end_of_its_log(torchrefrac, part_of_tank, report):
    folder = part_of_tank([0, 3])
    for path in (folder / "images").iterdir():
        path.unlink()

    ended = torchrefrac("scene=capture", f"scene.path={folder}", "out=run", reports=True)

    assert ended.status == 1
    (sentence,) = ended.err.removeprefix("error: ").splitlines()
    page = report()
    assert f"Failed before the first stage was complete: {sentence}" in page.text
    assert "cam00.jpg" in sentence
    assert "failed after" in page.text
    assert "Table 1" not in page.text


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["scene=mesh", "scene.file=nowhere.ply"], "scene.file: nowhere.ply cannot be read: No such file or directory"),
        (["scene=tank", "scene.index_ratio=abc"], "scene.index_ratio is 'abc', but must be a number"),
    ],
)
def test_a_scene_that_cannot_be_made_has_a_report_that_says_why(torchrefrac, report, arguments, sentence):
    ended = torchrefrac(*arguments, "out=run", reports=True)

    assert ended.err == f"error: {sentence}\n"
    page = report()
    assert sentence in page.text
    assert arguments[1] in page.text


def test_a_failed_run_without_a_report_leaves_none(torchrefrac, tmp_path):
    torchrefrac("scene=mesh", "scene.file=nowhere.ply", "report=false", "out=run", reports=True)

    assert (tmp_path / "run" / "metrics.json").is_file()
    assert not (tmp_path / "run" / "report.html").exists()


def test_an_adjusted_alignment_is_told_with_what_moved(torchrefrac, alignment, metrics, report, tmp_path):
    ended = torchrefrac("adjust", f"alignment={alignment}", "index_ratio=1.33", "out=run", reports=True)

    assert (ended.status, ended.err.count("error")) == (0, 0)
    page = report()
    for words in ("6 of 6 photographs", "What the photographs determine", "cam05.jpg", "index_ratio"):
        assert words in page.text, words
    assert any(load.startswith(FIGURE) for load in page.loads)
    log = (tmp_path / "run" / "run.log").read_text()
    assert "complete after" in log.splitlines()[-1]


def test_an_alignment_that_cannot_be_adjusted_has_a_report_that_says_why(torchrefrac, report, tmp_path):
    (tmp_path / "given").mkdir()

    ended = torchrefrac("adjust", "alignment=given", "index_ratio=1.33", "out=run", reports=True)

    assert ended.status == 1
    assert ended.err.splitlines()[-1].removeprefix("error: ") in report().text


def test_an_adjusted_alignment_without_a_report_leaves_none(torchrefrac, alignment, tmp_path):
    torchrefrac("adjust", f"alignment={alignment}", "index_ratio=1.33", "report=false", "out=run", reports=True)

    assert (tmp_path / "run" / "metrics.json").is_file()
    assert not (tmp_path / "run" / "report.html").exists()


def test_a_run_made_dense_later_has_a_report_of_both(torchrefrac, sparse, metrics, report, tmp_path):
    shutil.copytree(sparse / "run", tmp_path / "run")

    ended = torchrefrac("densify", "run=run", *QUICK, reports=True)

    assert (ended.status, ended.err.count("error")) == (0, 0)
    found = metrics(tmp_path / "run")
    page = report()
    for words in (
        "3 of 3 photographs placed",
        "What the photographs determine",
        f"{found['dense_points']}",
        "depthmap",
    ):
        assert words in page.text.replace("\u202f", ""), words
    assert "dense.ply" in page.links
    assert (
        f"{found['dense_points']:,} dense points".replace(",", "\u202f")
        in (tmp_path / "run" / "scene.html").read_text()
    )
    assert "complete after" in (tmp_path / "run" / "run.log").read_text().splitlines()[-1]


@pytest.fixture
def hopeless(sparse, tmp_path):
    """The folder of a run that has a report, and cameras that all stand in one place."""
    shutil.copytree(sparse / "run", tmp_path / "run")
    for name in PAGES:
        (tmp_path / "run" / name).write_text("of the sparse model alone")
    cameras = json.loads((tmp_path / "run" / "cameras.json").read_text())
    for image in cameras["images"]:
        image["center_in_world"] = [0.0, 0.0, 30.0]
    (tmp_path / "run" / "cameras.json").write_text(json.dumps(cameras))
    return tmp_path / "run"


def test_a_dense_stage_that_fails_is_told_with_its_reason(torchrefrac, hopeless, report):
    ended = torchrefrac("densify", f"run={hopeless}", reports=True)

    assert ended.status == 1
    reason = ended.err.splitlines()[-1].removeprefix("error: ")
    assert reason.startswith("no two of 3 registered images see common points")
    assert f"Failed after features, matching and sparse: {reason}" in report().text


def test_a_dense_stage_without_a_report_takes_away_that_of_before(torchrefrac, hopeless):
    torchrefrac("densify", f"run={hopeless}", "report=false", reports=True)

    assert (hopeless / "metrics.json").is_file()
    assert not any((hopeless / name).exists() for name in PAGES)


def test_a_run_that_cannot_be_opened_keeps_its_report(torchrefrac, hopeless):
    (hopeless / "cameras.json").unlink()

    ended = torchrefrac("densify", f"run={hopeless}", reports=True)

    assert (ended.status, ended.err.count("\n")) == (1, 1)
    assert all((hopeless / name).read_text() == "of the sparse model alone" for name in PAGES)
