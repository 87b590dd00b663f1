"""`torchrefrac correct` and `torchrefrac export` as a person uses them."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.correction.survey import looking_down
from torchrefrac import load_truth, read_scene
from torchrefrac.correction import CorrectionRules, correct_points
from torchrefrac.files.cameras import read_cameras, write_points
from torchrefrac.files.clouds import ply as ply_files
from torchrefrac.files.colmap.model import read_colmap, write_colmap
from torchrefrac.files.dense import write_dense
from torchrefrac.files.library import embedded_scene
from torchrefrac.files.ply import read_vertices
from torchrefrac.files.tracks import read_run
from torchrefrac.files.viewpoints import read_viewpoints, write_angles
from torchrefrac.files.water import read_water, write_water
from torchrefrac.geometry import align_similarity
from torchrefrac.scene import DenseCloud, Interfaces
from torchrefrac.sfm.frame import transformed

LEVEL = 400.5
BASE = torch.tensor((512_345.0, 5_123_456.0, LEVEL), dtype=torch.float64)
CALIBRATED = ("focal_px=1000", "size=[2400,2400]")


@pytest.fixture
def survey(tmp_path, draw):
    """cloud.csv, of which a tenth is land, and cameras.txt, in the folder of the command; the points and cameras."""
    points = torch.cat((draw.uniform(-8.0, 8.0, 60, 2), draw.uniform(-4.0, -0.5, 60, 1)), dim=-1)
    points[::10, 2] = 0.75
    center = torch.cat((draw.uniform(-12.0, 12.0, 8, 2), draw.uniform(28.0, 32.0, 8, 1)), dim=-1)
    points, cameras = torch.from_numpy(np.round((points + BASE).numpy(), 4)), looking_down(center + BASE)
    rows = [f"{x:.4f},{y:.4f},{z:.4f},{i}" for i, (x, y, z) in enumerate(points.tolist())]
    (tmp_path / "cloud.csv").write_text("\n".join(("x,y,z,id", *rows)) + "\n")
    write_angles(cameras, tmp_path / "cameras.txt")
    return points, cameras


def rows_of(path):
    head, *lines = path.read_text().splitlines()
    return [dict(zip(head.split(","), line.split(","), strict=True)) for line in lines]


def numbers(rows, *names):
    return np.array([[float(row[name]) for name in names] for row in rows])


@pytest.mark.parametrize("method", ["rays", "mean"])
def test_a_cloud_is_corrected_beside_a_record_and_a_report(torchrefrac, survey, metrics, tmp_path, method):
    points, cameras = survey
    before = (tmp_path / "cloud.csv").read_bytes()

    ended = torchrefrac("correct", "cloud=cloud.csv", "cameras=cameras.txt", f"water.level={LEVEL}", *CALIBRATED,
                        f"method={method}", "out=new")  # fmt: skip

    assert (ended.status, ended.err.count("error")) == (0, 0)
    assert "54 of 54 points below the water corrected, of 60 in all" in ended.out
    assert "if the poses come from an alignment without water" in " ".join(ended.out.split())
    assert max(map(len, ended.out.splitlines())) <= 100
    level = torch.full((60,), LEVEL, dtype=torch.float64)
    wet = torch.ones(60, dtype=torch.bool)
    expected = correct_points(points, level, wet, cameras, CorrectionRules(method=method))
    rows = rows_of(tmp_path / "new" / "corrected.csv")
    np.testing.assert_allclose(numbers(rows, "x", "y", "z"), expected.points.numpy(), atol=1e-4)
    np.testing.assert_allclose(numbers(rows, "views", "id"), np.stack((expected.views, range(60)), axis=-1))
    np.testing.assert_allclose(numbers(rows, "depth")[:, 0], expected.depth.numpy(), atol=1e-4)
    wet_rows = [row for i, row in enumerate(rows) if i % 10]
    incidence = expected.incidence[expected.corrected].rad2deg().numpy()
    np.testing.assert_allclose(numbers(wet_rows, "incidence")[:, 0], incidence, rtol=1e-5)
    np.testing.assert_allclose(numbers(wet_rows, "sigma")[:, 0], expected.sigma[expected.corrected].numpy(), rtol=1e-5)
    assert {row["sigma"] for row in rows[::10]} == {""}
    record = metrics(tmp_path / "new")
    assert (record["command"], record["points_corrected"], record["points_not_corrected"]) == ("correct", 54, 0)
    misfit = expected.misfit[expected.corrected].square().mean().sqrt()
    assert record["ray_misfit_rms_unit"] == pytest.approx(float(misfit), rel=1e-3)
    assert record["error_left_rms_unit"] > 0.0
    assert (tmp_path / "cloud.csv").read_bytes() == before
    assert sorted(path.name for path in (tmp_path / "new").iterdir()) == ["corrected.csv", "metrics.json"]


@pytest.mark.usefixtures("survey")
def test_a_camera_file_says_the_same_as_focal_length_and_size(torchrefrac, metrics, tmp_path):
    camera = {"width": 2400, "height": 2400, "fx": 1000.0, "fy": 1000.0, "cx": 1200.0, "cy": 1200.0}
    content = {"format": "torchrefrac-camera/1", "pixel_origin": "corner", "camera": camera}
    (tmp_path / "camera.json").write_text(json.dumps(content))
    given = ("correct", "cloud=cloud.csv", "cameras=cameras.txt", f"water.level={LEVEL}", "forecast=false")

    assert torchrefrac(*given, "camera=camera.json", "out=file").status == 0
    assert torchrefrac(*given, *CALIBRATED, "out=numbers").status == 0

    assert (tmp_path / "file" / "corrected.csv").read_text() == (tmp_path / "numbers" / "corrected.csv").read_text()
    ended = torchrefrac(*given, *CALIBRATED, "camera=camera.json", "out=both")
    assert "camera and focal_px are both given" in ended.err


def test_positions_of_cameras_are_enough_and_what_is_not_known_is_said(torchrefrac, survey, metrics, tmp_path):
    rows = (f"{i},{x},{y},{z}" for i, (x, y, z) in enumerate(survey[1].center.tolist()))
    (tmp_path / "positions.csv").write_text("\n".join(("name,x,y,z", *rows)))

    ended = torchrefrac("correct", "cloud=cloud.csv", "cameras=positions.csv", f"water.level={LEVEL}", "out=new")

    assert ended.status == 0
    assert "by how much is not known here" in " ".join(ended.out.split())
    assert "error_left_rms_unit" not in metrics(tmp_path / "new")


def test_a_raster_of_the_water_says_where_there_is_some(torchrefrac, survey, metrics, tmp_path):
    rasterio = pytest.importorskip("rasterio")
    heights = np.full((20, 10), LEVEL, dtype=np.float32)  # of the western half
    west, north = float(BASE[0]) - 10.0, float(BASE[1]) + 10.0
    write_raster(tmp_path / "water.tif", heights, rasterio.Affine(1.0, 0.0, west, 0.0, -1.0, north), "EPSG:32633")
    in_west = survey[0][:, 0] <= BASE[0]

    ended = torchrefrac("correct", "cloud=cloud.csv", "cameras=cameras.txt", "water.surface=water.tif", *CALIBRATED,
                        "crs=EPSG:32633", "forecast=false", "out=new")  # fmt: skip

    assert ended.status == 0
    record = metrics(tmp_path / "new")
    assert record["points_without_water"] == int((~in_west).sum())
    assert record["depth_mean_m"] > 0.0
    corrected = numbers(rows_of(tmp_path / "new" / "corrected.csv"), "views")[:, 0] > 0
    assert np.array_equal(corrected, (in_west & (survey[0][:, 2] < LEVEL)).numpy())
    assert "points lie where water.surface has no water" in ended.out


def write_raster(path, heights, place, crs):
    rasterio = pytest.importorskip("rasterio")
    rows, columns = heights.shape
    kind = {"driver": "GTiff", "width": columns, "height": rows, "count": 1, "dtype": "float32", "crs": crs}
    with rasterio.open(path, "w", transform=place, **kind) as file:
        file.write(heights, 1)


def test_the_same_command_again_replaces_what_it_wrote_and_nothing_else(torchrefrac, survey, tmp_path):
    given = ("correct", "cloud=cloud.csv", "cameras=cameras.txt", f"water.level={LEVEL}", "forecast=false")
    assert torchrefrac(*given, "out=new").status == 0
    first = (tmp_path / "new" / "corrected.csv").read_bytes()

    assert torchrefrac(*given, "out=new").status == 0
    assert (tmp_path / "new" / "corrected.csv").read_bytes() == first
    (tmp_path / "old").mkdir()
    (tmp_path / "old" / "corrected.csv").write_text("mine")
    ended = torchrefrac(*given, "out=old")

    assert ended.status == 1
    assert "old holds corrected.csv, which no correct has written; name another folder as out" in ended.err
    assert (tmp_path / "old" / "corrected.csv").read_text() == "mine"


def test_points_that_no_camera_sees_are_counted_and_marked(torchrefrac, survey, metrics, tmp_path):
    with (tmp_path / "cloud.csv").open("a") as file:
        file.write(f"{BASE[0] + 500.0},{BASE[1]},{LEVEL - 2.0},60\n")

    ended = torchrefrac("correct", "cloud=cloud.csv", "cameras=cameras.txt", f"water.level={LEVEL}", *CALIBRATED,
                        "out=new")  # fmt: skip

    assert ended.status == 0
    assert "not corrected, as too few cameras see them: 1 points" in ended.out
    assert metrics(tmp_path / "new")["points_not_corrected"] == 1
    last = rows_of(tmp_path / "new" / "corrected.csv")[-1]
    assert (float(last["z"]), last["views"], last["sigma"]) == (LEVEL - 2.0, "0", "")


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"water.level": "500"}, "but all 8 cameras are below it (the highest at 4"),
        ({"water.level": "390"}, "no point of cloud.csv lies below the water: the lowest lies"),
        ({"water.level": "null"}, "water.level and water.surface are both missing"),
        ({"water.surface": "water.tif"}, "water.level and water.surface are both given"),
        ({"max_angle_deg": "0.01"}, "is seen by 2 cameras within max_angle_deg=0.01: cameras stand in x 512"),
        ({"min_views": "9"}, "is seen by 9 cameras within"),
        ({"min_views": "1"}, "min_views is 1, but rays meet where there are 2 or more; or method=mean"),
        ({"cloud": "none.csv"}, "none.csv is not a file, but cloud must be one"),
        ({"cameras": "none.txt"}, "none.txt does not exist"),
        ({"size": "null"}, "focal_px and size must be given together"),
        ({"crs": "Atlantis"}, "crs is 'Atlantis', which is no coordinate reference system"),
        ({"method": "best"}, "method is 'best', but must be one of rays, mean"),
    ],
)
@pytest.mark.usefixtures("survey")
def test_what_cannot_be_right_is_one_sentence(torchrefrac, tmp_path, changes, sentence):
    options = {"cloud": "cloud.csv", "cameras": "cameras.txt", "water.level": str(LEVEL), "out": "new",
               "focal_px": "1000", "size": "[2400,2400]"}  # fmt: skip

    ended = torchrefrac("correct", *(f"{name}={value}" for name, value in (options | changes).items()))

    assert ended.status == 1
    (line,) = (line for line in ended.err.splitlines() if line.startswith("error: "))
    assert sentence in line
    assert not list((tmp_path / "new").glob("*"))


def test_reference_systems_are_not_mixed(torchrefrac, survey, tmp_path):
    laspy, pyproj = pytest.importorskip("laspy"), pytest.importorskip("pyproj")
    rasterio = pytest.importorskip("rasterio")
    cloud = laspy.create(point_format=3)
    cloud.header.add_crs(pyproj.CRS.from_epsg(32633))
    cloud.header.offsets, cloud.header.scales = BASE.floor().numpy(), np.full(3, 1e-4)
    cloud.x, cloud.y, cloud.z = survey[0].T.numpy()
    cloud.write(tmp_path / "cloud.laz")
    place = rasterio.Affine(1e3, 0.0, 512e3, 0.0, -1e3, 5124e3)
    write_raster(tmp_path / "water.tif", np.full((1, 1), LEVEL, dtype=np.float32), place, "EPSG:32632")
    given = ("correct", "cloud=cloud.laz", "cameras=cameras.txt", "forecast=false", "out=new")

    ended = torchrefrac(*given, "water.surface=water.tif")

    assert ended.status == 1
    assert "the cloud is in WGS 84 / UTM zone 33N, but water.surface in WGS 84 / UTM zone 32N" in ended.err
    ended = torchrefrac(*given, f"water.level={LEVEL}", "crs=EPSG:32632")
    assert "crs is in WGS 84 / UTM zone 32N, but the cloud in WGS 84 / UTM zone 33N" in ended.err
    ended = torchrefrac(*given, f"water.level={LEVEL}", "crs=Atlantis")
    assert "crs is 'Atlantis', which is no coordinate reference system" in ended.err
    assert torchrefrac(*given, f"water.level={LEVEL}").status == 0
    found = laspy.read(tmp_path / "new" / "corrected.laz")
    assert np.array_equal(found.z[::10], cloud.z[::10])
    assert (found["depth"][1::10] > found["apparent_depth"][1::10]).all()


def exported(torchrefrac, tmp_path, run, form):
    ended = torchrefrac("export", f"run={run}", f"format={form}", f"out={form}")
    assert (ended.status, ended.err) == (0, "")
    assert "3 cameras" in ended.out
    return tmp_path / form


@pytest.mark.parametrize(("form", "name"), [("opk", "cameras_opk.txt"), ("csv", "cameras.csv")])
def test_exported_tables_come_back(torchrefrac, sparse, tmp_path, form, name):
    scene = read_cameras(sparse / "run" / "cameras.json")

    folder = exported(torchrefrac, tmp_path, sparse / "run", form)

    found = read_viewpoints(folder / name)
    assert found.names == scene.views.names
    torch.testing.assert_close(found.center, scene.views.center, rtol=0.0, atol=1e-7)
    torch.testing.assert_close(found.rotation, scene.views.rotation, rtol=0.0, atol=1e-9)
    water, _ = read_water(folder / "water.json", found.names)
    assert (float(water.index_ratio), water.is_level) == (scene.index_ratio, True)
    if form == "csv":
        sigma = scene.assessment.center_covariance[0].diagonal().sqrt()
        head, first, *_ = (folder / name).read_text().splitlines()
        row = dict(zip(head.split(","), first.split(","), strict=True))
        assert [float(row[f"sigma_{axis}"]) for axis in "xyz"] == pytest.approx(sigma.tolist(), rel=1e-6)


def test_an_exported_model_has_the_points_too(torchrefrac, sparse, tmp_path):
    scene = read_scene(sparse / "run")

    folder = exported(torchrefrac, tmp_path, sparse / "run", "colmap")

    model = read_colmap(folder)
    torch.testing.assert_close(model.points, scene.points, rtol=0.0, atol=1e-12)
    torch.testing.assert_close(model.views.center, scene.views.center, rtol=0.0, atol=1e-9)
    assert json.loads((folder / "water.json").read_text())["index_ratio"] == scene.index_ratio


def test_tables_are_on_the_map_where_the_run_says_where_it_stands(torchrefrac, sparse, tmp_path):
    shutil.copytree(sparse / "run", tmp_path / "run")
    path = tmp_path / "run" / "cameras.json"
    content = json.loads(path.read_text())
    place = {"crs": "EPSG:32633", "origin": [512_000.0, 5_123_000.0, 400.25], "scale": 0.9996}
    path.write_text(json.dumps(content | {"georeference": place, "length_unit": "m"}))
    center = read_cameras(path).views.center

    found = read_viewpoints(exported(torchrefrac, tmp_path, "run", "opk") / "cameras_opk.txt")

    expected = center * torch.tensor((0.9996, 0.9996, 1.0)) + torch.tensor((512_000.0, 5_123_000.0, 400.25))
    torch.testing.assert_close(found.center, expected.double(), rtol=0.0, atol=1e-6)
    water, _ = read_water(tmp_path / "opk" / "water.json", found.names)
    assert water.offset.tolist() == [400.25]
    path.write_text(json.dumps(content | {"georeference": place | {"slope": [0.02, -0.01]}, "length_unit": "m"}))
    falling = read_viewpoints(exported(torchrefrac, tmp_path, "run", "csv") / "cameras.csv")
    water, _ = read_water(tmp_path / "csv" / "water.json", found.names)
    up = torch.nn.functional.normalize(torch.tensor((0.02, -0.01, 1.0)).double(), dim=0)
    plumb = water.planes.signed_distance(falling.center) / water.normal[0, 2]
    torch.testing.assert_close(plumb * up[2], center[:, 2], rtol=0.0, atol=1e-6)
    torch.testing.assert_close(falling.rotation[:, :, 2], read_cameras(path).views.rotation @ up, rtol=0.0, atol=1e-9)
    local = read_colmap(exported(torchrefrac, tmp_path, "run", "colmap"))
    torch.testing.assert_close(local.views.center, center, rtol=0.0, atol=1e-9)


def test_an_adjustment_with_its_water_anywhere_is_exported_too(torchrefrac, sparse, tmp_path):
    scene = read_scene(sparse / "run")
    raised = replace(scene, interfaces=Interfaces.level(1.34, 2.5))
    write_colmap(raised, tmp_path / "adjusted" / "colmap")
    write_water(raised, tmp_path / "adjusted" / "water.json")
    record = {"status": "complete", "stages": ["adjusting"], "command": "adjust", "length_unit": "mm"}
    (tmp_path / "adjusted" / "metrics.json").write_text(json.dumps(record))

    folder = exported(torchrefrac, tmp_path, "adjusted", "csv")

    torch.testing.assert_close(read_viewpoints(folder / "cameras.csv").center, scene.views.center, rtol=0.0, atol=1e-7)
    water = json.loads((folder / "water.json").read_text())
    assert (water["index_ratio"], water["length_unit"], water["planes"][0]["offset"]) == (1.34, "mm", 2.5)


def test_what_is_no_run_is_refused(torchrefrac, tmp_path):
    (tmp_path / "empty").mkdir()

    for run, sentence in (("none", "none is not a folder"), ("empty", "empty holds neither cameras.json nor colmap/")):
        ended = torchrefrac("export", f"run={run}", "out=there")
        assert ended.status == 1
        assert sentence in ended.err


@pytest.mark.slow
def test_the_error_left_of_the_tank_without_refraction_is_of_the_order_that_is_said(
    torchrefrac, metrics, tmp_path, monkeypatch
):
    capture = embedded_scene("tank_small")
    truth = load_truth(capture)
    ended = torchrefrac("scene=capture", f"scene.path={capture}", "model=none", "out=none", "report=false")
    assert ended.status == 0
    scene = read_scene(tmp_path / "none")
    true = truth.center[[truth.names.index(name) for name in scene.views.names]]
    scene = transformed(scene, align_similarity(scene.views.center, true))
    write_colmap(scene, tmp_path / "model")
    write_points(scene.points, scene.colors, tmp_path / "cloud.ply")
    monkeypatch.setattr(ply_files, "CHUNK", 1000)

    ended = torchrefrac("correct", "cloud=cloud.ply", "cameras=model", "water.level=0", "index_ratio=1.33", "out=new")

    assert ended.status == 0
    vertices, _ = read_vertices(tmp_path / "new" / "corrected.ply")
    corrected = torch.from_numpy(np.stack([vertices[axis] for axis in "xyz"], axis=-1).astype(np.float64))
    off = {name: float(_from_planes(truth, points)) for name, points in (("left", corrected), ("before", scene.points))}
    said = metrics(tmp_path / "new")
    assert off["left"] > 3.0 * off["before"]  # poses that took up the refraction
    assert (
        said["error_left_rms_unit"] / 3.0 < off["left"] < said["error_left_rms_unit"]
    )  # planes are nearer than points
    assert said["error_uncorrected_rms_unit"] / 3.0 < off["before"] < said["error_uncorrected_rms_unit"]
    assert "the corrected points are farther off than those given" in ended.out


def _from_planes(truth, points):
    """Root mean square distance from the nearest of the true planes."""
    away = ((points[:, None] - truth.corner) * truth.normal).sum(dim=-1).abs().amin(dim=-1)
    return away.square().mean().sqrt()


def test_products_of_a_survey_are_made_from_a_run_that_is_dense(torchrefrac, sparse, tmp_path):
    pytest.importorskip("laspy")
    run = tmp_path / "run"
    shutil.copytree(sparse / "run", run)
    scene = read_run(run)
    x, y = torch.meshgrid(*(torch.arange(0.0, 20.0, 0.5, dtype=torch.float64),) * 2, indexing="ij")
    points = torch.stack((x.flatten(), y.flatten(), torch.full((x.numel(),), -5.0, dtype=torch.float64)), dim=-1)
    ones, count = torch.ones(len(points), dtype=torch.float64), torch.full((len(points),), 3)
    up, grey = torch.tensor((0.0, 0.0, 1.0)).double().expand(len(points), 3), torch.full((len(points), 3), 99)
    reference = torch.zeros_like(count)
    cloud = DenseCloud(
        points, up, grey.to(torch.uint8), 0.1 * ones, ones, count, reference, 0.1 * ones, scene.length_unit,
    )  # fmt: skip

    missing = torchrefrac("export", "run=run", "format=survey", "out=rasters")
    write_dense(cloud, run / "dense.ply")
    ended = torchrefrac(
        "export", "run=run", "format=survey", "outputs.raster_cell=1", "outputs.orthophoto=false", "out=rasters"
    )

    assert missing.status == 1
    assert "run holds no dense.ply: make it dense first" in missing.err
    assert ended.status == 0, ended.err
    made = {path.name for path in (tmp_path / "rasters").iterdir()}
    assert made >= {"dense.laz", "points.laz", "dsm.tif", "depth.tif", "sigma.tif", "contours.geojson", "metrics.json"}
    assert "orthophoto.tif" not in made
    assert "bed: " in ended.out
