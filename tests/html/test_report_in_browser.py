"""A report and its scene in a real browser, without a window: on a desk, on a telephone, on paper."""

import html
import json
import re
import shutil
import subprocess

import cv2
import pytest
import torch

from tests.html.html_runs import Planted
from torchrefrac.html import write_report

BROWSERS = ("chromium", "chromium-browser", "google-chrome")
SECONDS = 60
PHONE, DESK, TALL = 390, 1280, 800
PAGES = ("report.html", "scene.html")
FRAMES = """<!DOCTYPE html><title>frames</title>
<style>body {{ margin: 0; }} iframe {{ border: 0; float: left; }}</style>
<iframe src="{page}" style="width:{phone}px;height:{tall}px"></iframe>
<iframe src="{page}" style="width:{desk}px;height:{tall}px"></iframe>"""
# Two frames of different widths, and what became of the page in each of them.
LOOK = (
    FRAMES
    + """<pre></pre>
<script>onload = () => {{
  document.querySelector("pre").textContent = JSON.stringify([...document.querySelectorAll("iframe")].map(frame => {{
    const page = frame.contentDocument, root = page.documentElement;
    return {{
      inner: root.clientWidth, needed: root.scrollWidth, title: page.title,
      broken: [...page.images].filter(image => !image.complete || !image.naturalWidth).length,
      fetched: frame.contentWindow.performance.getEntriesByType("resource").map(entry => entry.name),
      font: parseFloat(frame.contentWindow.getComputedStyle(page.body).fontSize),
      outside: [...page.querySelectorAll("section, h1, h2, h3, p, dl, figcaption")].filter(
        part => part.getBoundingClientRect().right > root.clientWidth + 1).length,
    }};
  }}));
}};</script>"""
)


# Errors of the page's program; and its use, with what the canvas shows after each step.
WATCH = """<script>
const errors = [];
addEventListener("error", event => errors.push(event.message));
requestAnimationFrame = draw => draw();
const get = HTMLCanvasElement.prototype.getContext;
HTMLCanvasElement.prototype.getContext = function (kind, how) {
  return get.call(this, kind, {...how, preserveDrawingBuffer: true});
};
</script>"""
USE = """<pre id="errors"></pre><pre id="views"></pre>
<script>onload = () => {
  const canvas = document.getElementById("view"), views = [];
  const press = (key, shiftKey) => canvas.dispatchEvent(new KeyboardEvent("keydown", {key, shiftKey}));
  const point = (kind, pointerId, clientX, clientY) => canvas.dispatchEvent(
    new PointerEvent(kind, {pointerId, clientX, clientY}));
  canvas.setPointerCapture = () => {};
  const steps = [
    () => press("0"), () => press("ArrowLeft"), () => press("ArrowUp", true), () => press("+"),
    () => document.getElementById("along").click(), () => document.getElementById("side").click(),
    () => canvas.dispatchEvent(new WheelEvent("wheel", {deltaY: 100})),
    () => { point("pointerdown", 1, 100, 100); point("pointermove", 1, 150, 120); },
    () => { point("pointerdown", 2, 200, 200); point("pointermove", 2, 250, 260); },
    () => document.getElementById("cameras").click(), () => document.getElementById("surface").click(),
    () => document.querySelector("input[value=depth]").click(),
    () => {
      for (const id of ["cameras", "surface"]) document.getElementById(id).click();
      document.querySelector("input[value=photograph]").click();
      press("0");
    },
  ];
  for (const step of steps) {
    step();
    views.push(canvas.toDataURL());
  }
  document.getElementById("errors").textContent = errors.join();
  document.getElementById("views").textContent = JSON.stringify(views);
};</script>"""


@pytest.fixture(scope="module")
def browse(tmp_path_factory):
    """`browse(address, *options)` starts the browser, without a network, and returns what it prints."""
    found = next(filter(None, map(shutil.which, BROWSERS)), None)
    if found is None:
        pytest.skip(f"none of {', '.join(BROWSERS)} is installed")
    profile = tmp_path_factory.mktemp("profile")

    def start(address, *options):
        command = [
            found, "--headless", "--hide-scrollbars", "--enable-unsafe-swiftshader",
            "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage", "--no-first-run",
            "--host-resolver-rules=MAP * ~NOTFOUND", f"--user-data-dir={profile}", *options, address,
        ]  # fmt: skip
        return subprocess.run(command, capture_output=True, check=True, timeout=SECONDS).stdout.decode("utf-8")

    return start


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    return write_report(Planted(tmp_path_factory.mktemp("run"), torch.Generator().manual_seed(1)).complete("tank"))


@pytest.fixture
def frames(report, tmp_path):
    """`frames(name, template)` writes a page with one of the run in two frames, of a telephone's width and a desk's."""

    def written(name, template):
        path = tmp_path / "frames.html"
        page = (report.parent / name).as_uri()
        path.write_text(template.format(page=page, phone=PHONE, desk=DESK, tall=TALL))
        return path.as_uri()

    return written


@pytest.mark.parametrize("name", PAGES)
def test_it_shows_all_its_pictures_fetches_nothing_and_does_not_scroll_sideways(browse, frames, name):
    shown = browse(frames(name, LOOK), "--allow-file-access-from-files", "--dump-dom")

    phone, desk = json.loads(html.unescape(re.search(r"<pre>(.*?)</pre>", shown, re.DOTALL).group(1)))
    for frame in (phone, desk):
        assert frame["title"].startswith("tank_small: Refraction")
        assert frame["broken"] == 0
        assert [name for name in frame["fetched"] if not name.startswith("data:")] == []
        assert frame["needed"] <= frame["inner"]
        assert frame["outside"] == 0
        assert frame["font"] >= 16
    assert PHONE - 20 <= phone["inner"] <= PHONE


def test_the_scene_is_drawn_on_a_telephone_and_on_a_desk(browse, frames, tmp_path):
    target = tmp_path / "scene.png"

    browse(frames("scene.html", FRAMES), f"--window-size={PHONE + DESK},{TALL}", f"--screenshot={target}")

    picture = cv2.imread(str(target))
    assert picture.shape == (TALL, PHONE + DESK, 3)
    for stage in (picture[100:500, :PHONE], picture[100:600, PHONE:]):
        ground = stage[0, 0].astype(int)
        assert 0.02 < (abs(stage.astype(int) - ground).max(axis=-1) > 8).mean() < 0.9
        assert (stage < 60).all(axis=-1).sum() > 200  # cameras and dark points


def test_the_scene_answers_keys_buttons_and_a_choice_of_colours(browse, report, tmp_path):
    page = (report.parent / "scene.html").read_text()
    copy = tmp_path / "scene.html"
    copy.write_text(page.replace("<head>", f"<head>{WATCH}").replace("</body>", f"{USE}</body>"))

    shown = browse(copy.as_uri(), "--dump-dom")

    assert re.search(r'<pre id="errors"></pre>', shown)
    assert "Depth below the water surface (cm)" in shown
    views = json.loads(html.unescape(re.search(r'<pre id="views">(.*?)</pre>', shown).group(1)))
    assert len(set(views)) == len(views) - 1  # all at the beginning and at the end


def test_without_webgl_the_scene_says_what_it_needs(browse, report):
    shown = browse((report.parent / "scene.html").as_uri(), "--disable-webgl", "--disable-3d-apis", "--dump-dom")

    assert re.search(r'<p id="missing" class="bad-box">This page needs WebGL', shown)


def test_it_prints_on_a_few_pages(browse, report, tmp_path):
    target = tmp_path / "report.pdf"

    browse(report.as_uri(), "--no-pdf-header-footer", f"--print-to-pdf={target}")

    pages = len(re.findall(rb"/Type\s*/Page\b", target.read_bytes()))
    assert 3 <= pages <= 7
