"""Reports of what was seen through walls and ports: they speak of glass, not of heights above water."""

import html
import re
from dataclasses import replace

import pytest
import torch

from tests.html.html_runs import Planted
from torchrefrac.files.cameras import write_cameras
from torchrefrac.files.capture import load_capture
from torchrefrac.files.library import embedded_scene
from torchrefrac.html import write_report
from torchrefrac.html.words import interfaces
from torchrefrac.scene import Interfaces


def glazed(kind, normal, offset, thickness):
    """One interface of glass."""

    def table(*values):
        return torch.tensor([values], dtype=torch.float64)

    place = table(*normal), table(offset)[:, 0]
    return Interfaces(*place, table(1.333)[:, 0], table(1.52), table(thickness), kinds=(kind,))


WALL = glazed("wall", (0.0, 0.0, 1.0), 0.0, 1.2)
PORT = glazed("port", (0.0, 0.0, -1.0), -2.0, 0.8)


@pytest.fixture
def report(tmp_path, generator):
    """`report(interfaces)`: the words of a planted run whose views look through them, without what stands in images."""

    def write(through, **metrics):
        planted = Planted(tmp_path, generator)
        run = planted.complete("run", **metrics)
        scene = planted.scene(1.333)
        write_cameras(replace(scene, interfaces=through), run / "cameras.json")
        page = write_report(run).read_text(encoding="utf-8")
        page = page[page.index("<body") :]
        return " ".join(html.unescape(re.sub(r"<[^>]*>", " ", re.sub(r'"data:[^"]*"', '""', page))).split())

    return write


def test_a_wall_s_report_counts_from_the_glass(report):
    page = report(WALL, interface="wall", wall_upright_off_deg=0.123, wall_upright_sigma_deg=0.4)

    for words in (
        "with refraction at the wall of glass, exactly",
        "coloured by distance from the glass: dark the farthest, light the nearest",
        "distance from the glass (cm)",
        "off the normal of the glass (°)",
        "angle at which the ray met the glass (0° is straight at it)",
        "How far the wall moves things",
        "behind the glass (the median distance of the points)",
        "the wall is 0.12° from it, ± 0.40°",
        "Scale follows from the thickness of the glass alone",
    ):
        assert words in page, words
    for words in ("above the water", "below the water", "water surface", "off vertical", "what you flew"):
        assert words not in page, words


def test_a_port_s_report_has_neither_a_level_nor_a_vertical_of_the_water(report):
    page = report(PORT, interface="port")

    for words in (
        "with refraction at the port of the housing, exactly",
        "angle at which the ray met the port (0° is straight through it)",
        "How far the port moves things",
        "before the port (the median distance of the points)",
        "Scale follows from the distance and the glass of the port alone",
    ):
        assert words in page, words
    for words in ("above the water", "below the water", "water surface", "what you flew"):
        assert words not in page, words


def test_what_is_looked_through_is_said_as_it_is_stated():
    capture = load_capture(embedded_scene("tank_small"))
    tilted = torch.tensor(((0.0, 0.05, -1.0),), dtype=torch.float64)
    port = replace(PORT, normal=torch.nn.functional.normalize(tilted))

    assert interfaces(capture) == ""
    assert interfaces(replace(capture, interfaces=WALL)) == "a wall of 1.2 cm of glass (1.52) before water of 1.333"
    assert interfaces(replace(capture, interfaces=port)) == (
        "a flat port 2 cm ahead, tilted by 2.9°, of 0.8 cm of glass (1.52) before water of 1.333"
    )
    both = Interfaces.joined([WALL, Interfaces.level(1.333)])
    assert interfaces(replace(capture, interfaces=both)).endswith("1.333; a surface of water of 1.333")
