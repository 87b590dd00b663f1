"""A report in a real browser, without a window: on a desk, on a telephone, on paper."""

import html
import json
import re
import shutil
import subprocess

import pytest
import torch

from tests.html.html_runs import Planted
from torchrefrac.html import write_report

BROWSERS = ("chromium", "chromium-browser", "google-chrome")
SECONDS = 60
PHONE, DESK = 390, 1280
# Two frames of different widths, and what became of the page in each of them.
LOOK = """<!DOCTYPE html><title>frames</title>
<iframe src="{page}" style="width:{phone}px;height:800px"></iframe>
<iframe src="{page}" style="width:{desk}px;height:800px"></iframe><pre></pre>
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


@pytest.fixture(scope="module")
def browse(tmp_path_factory):
    """`browse(address, *options)` starts the browser, without a network, and returns what it prints."""
    found = next(filter(None, map(shutil.which, BROWSERS)), None)
    if found is None:
        pytest.skip(f"none of {', '.join(BROWSERS)} is installed")
    profile = tmp_path_factory.mktemp("profile")

    def start(address, *options):
        command = [
            found, "--headless", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage", "--no-first-run",
            "--host-resolver-rules=MAP * ~NOTFOUND", f"--user-data-dir={profile}", *options, address,
        ]  # fmt: skip
        return subprocess.run(command, capture_output=True, check=True, timeout=SECONDS).stdout.decode("utf-8")

    return start


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    return write_report(Planted(tmp_path_factory.mktemp("run"), torch.Generator().manual_seed(1)).complete("tank"))


def test_it_shows_all_its_pictures_fetches_nothing_and_does_not_scroll_sideways(browse, report, tmp_path):
    look = tmp_path / "look.html"
    look.write_text(LOOK.format(page=report.as_uri(), phone=PHONE, desk=DESK))

    shown = browse(look.as_uri(), "--allow-file-access-from-files", "--dump-dom")

    phone, desk = json.loads(html.unescape(re.search(r"<pre>(.*?)</pre>", shown, re.DOTALL).group(1)))
    for frame in (phone, desk):
        assert frame["title"] == "tank_small: Refraction"
        assert frame["broken"] == 0
        assert [name for name in frame["fetched"] if not name.startswith("data:")] == []
        assert frame["needed"] <= frame["inner"]
        assert frame["outside"] == 0
        assert frame["font"] >= 16
    assert PHONE - 20 <= phone["inner"] <= PHONE


def test_it_prints_on_a_few_pages(browse, report, tmp_path):
    target = tmp_path / "report.pdf"

    browse(report.as_uri(), "--no-pdf-header-footer", f"--print-to-pdf={target}")

    pages = len(re.findall(rb"/Type\s*/Page\b", target.read_bytes()))
    assert 3 <= pages <= 12
