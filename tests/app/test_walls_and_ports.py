"""Aquariums and housings in full, through the command: from photographs to reports, and to other programs."""

import html
import json
import re
from dataclasses import replace

import pytest
import torch

from tests.html.html_runs import Planted
from torchrefrac.commands.export import export_run
from torchrefrac.config import OptionError
from torchrefrac.config.clouds import ExportOptions
from torchrefrac.files.cameras import write_cameras
from torchrefrac.files.colmap.model import read_colmap
from torchrefrac.files.dense import write_dense
from torchrefrac.files.water import read_water
from torchrefrac.scene import DenseCloud, Georeference, Interfaces

KINDS = {"wall": ((0.6, 0.0, 0.8), 0.0), "port": ((0.1, 0.0, -(0.99**0.5)), -2.0)}
PLACE = Georeference("EPSG:32633", (412000.0, 5013000.0, 431.0), scale=0.9996)
LESS = ("features.max_features=2000", "scene.sensor.samples=1")


def _table(*rows):
    return torch.tensor(rows, dtype=torch.float64)


@pytest.fixture
def planted(tmp_path, generator):
    """`planted(kind, place)`: the folder of a run whose views look through 1.2 cm of glass, and what they do."""

    def plant(kind, place=None):
        maker = Planted(tmp_path, generator)
        run, (normal, offset) = maker.complete("run"), KINDS[kind]
        glass = Interfaces(_table(normal), _table(offset), _table(1.333), _table((1.52,)), _table((1.2,)), (kind,))
        unit = "cm" if place is None else "m"
        scene = replace(maker.scene(1.33), interfaces=glass, georeference=place, length_unit=unit)
        write_cameras(scene, run / "cameras.json")
        return run, glass

    return plant


def _same(found, wanted):
    assert found.kinds == wanted.kinds
    for name in ("normal", "offset", "index_ratio", "layers", "thickness"):
        torch.testing.assert_close(getattr(found, name), getattr(wanted, name), rtol=0.0, atol=1e-12)


@pytest.fixture
def export(tmp_path):
    """`export(run, form)`: the folder of what is exported."""

    def start(run, form):
        export_run(ExportOptions(str(run), str(tmp_path / form), form))
        return tmp_path / form

    return start


@pytest.mark.parametrize("form", ["colmap", "opk", "csv"])
@pytest.mark.parametrize("kind", KINDS)
def test_exported_cameras_have_what_they_look_through_beside_them(planted, export, kind, form):
    run, glass = planted(kind)

    folder = export(run, form)

    names = read_colmap(folder).views.names if form == "colmap" else ("cam00.jpg",)
    _same(read_water(folder / "water.json", names)[0], glass)


def test_on_the_map_a_wall_stands_where_its_points_do(planted, export):
    run, _ = planted("wall", PLACE)

    wall, _ = read_water(export(run, "csv") / "water.json", ("cam00.jpg",))

    on_glass = torch.tensor(((4.0, -2.0, -3.0), (-80.0, 40.0, 60.0)), dtype=torch.float64)
    gap = wall.planes.indexed(0, (1,)).signed_distance(PLACE.coordinates(on_glass))
    assert gap.abs().max() < 1e-6


def test_on_the_map_a_port_stays_with_its_camera(planted, export):
    run, glass = planted("port", PLACE)

    _same(read_water(export(run, "opk") / "water.json", ("cam00.jpg",))[0], glass)


@pytest.mark.parametrize("kind", KINDS)
def test_products_of_a_survey_are_refused_before_anything_but_a_surface_of_water(planted, export, tmp_path, kind):
    run, _ = planted(kind)
    write_dense(DenseCloud.empty("cm"), run / "dense.ply")

    with pytest.raises(OptionError, match=f"look through a {kind}; take dense.ply, mesh.ply and dsm.npz"):
        export(run, "survey")
    assert not (tmp_path / "survey").exists()


def _words(run):
    page = (run / "report.html").read_text(encoding="utf-8")
    text = re.sub(r"<[^>]*>", " ", re.sub(r'"data:[^"]*"', '""', page[page.index("<body") :]))
    return " ".join(html.unescape(text).split())


@pytest.fixture
def run(torchrefrac, tmp_path):
    """The metrics of a run with these arguments, which must succeed, and the words of its report."""

    def start(*arguments):
        ended = torchrefrac(*arguments, *LESS, f"cache={tmp_path / 'scenes'}", "out=run", reports=True)
        assert ended.status == 0, ended.err
        folder = tmp_path / "run"
        return json.loads((folder / "metrics.json").read_text(encoding="utf-8")), _words(folder)

    return start


@pytest.mark.slow
def test_an_aquarium_is_reconstructed_through_its_glass(run):
    phones = "[{width: 640, height: 480, fov_deg: 60.0}, {width: 480, height: 640, fov_deg: 46.0}]"

    found, words = run("scene=aquarium", "scene.images=8", f"scene.cameras={phones}", "dense=patch")

    assert found["registered_images"] == found["images"] == 8
    assert found["warnings"] == []
    assert found["camera_rms_cm"] < 0.05
    assert found["dense_accuracy_within_0.1_cm"] > 0.95
    assert found["wall_upright_off_deg"] < 4.0 * found["wall_upright_sigma_deg"]
    assert "a wall of 1.2 cm of glass (1.52) before water of 1.333" in words
    assert "distance from the glass (cm)" in words
    assert "above the water" not in words


@pytest.mark.slow
def test_a_reef_is_reconstructed_through_the_port_of_a_housing(run):
    camera = "{width: 640, height: 480, fov_deg: 75.0}"

    found, words = run("scene=housing", "scene.columns=3", "scene.rows=3", f"scene.camera={camera}")

    assert found["registered_images"] == found["images"] == 9
    assert found["warnings"] == []
    assert found["camera_rms_cm"] < 0.1
    assert "a flat port 2 cm ahead, tilted by 1°, of 0.8 cm of glass (1.52) before water of 1.333" in words
    assert "above the water" not in words
