"""Cameras of other programs: tables and Metashape's XML, against single turns and projections by pyproj."""

import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from torchrefrac.camera import Intrinsics
from torchrefrac.files.viewpoints import read_viewpoints, write_angles, write_orientations
from torchrefrac.scene import SceneError, Viewpoints

NAMES = ("IMG 1.JPG", "b.jpg", "ü.jpg", "d.jpg")


@pytest.fixture
def cameras(draw):
    """Turned any way, on a map."""
    center = torch.tensor((512_345.0, 5_123_456.0, 440.0), dtype=torch.float64) + draw.uniform(-50.0, 50.0, 4, 3)
    return Viewpoints(NAMES, center, draw.rotations(4))


@pytest.mark.parametrize("write", [write_angles, write_orientations])
def test_tables_come_back(tmp_path, cameras, write):
    write(cameras, tmp_path / "cameras.txt")

    found = read_viewpoints(tmp_path / "cameras.txt")

    assert (found.names, found.field, found.crs) == (NAMES, None, None)
    torch.testing.assert_close(found.center, cameras.center, rtol=0.0, atol=1e-7)
    torch.testing.assert_close(found.rotation, cameras.rotation, rtol=0.0, atol=1e-9)


def test_standard_deviations_stand_behind_the_angles(tmp_path, cameras):
    write_orientations(cameras, tmp_path / "cameras.csv", torch.full((4, 3), 0.02, dtype=torch.float64))

    head, first, *_ = (tmp_path / "cameras.csv").read_text(encoding="utf-8").splitlines()
    assert head == "name,x,y,z,yaw,pitch,roll,sigma_x,sigma_y,sigma_z"
    assert first.endswith(",0.02,0.02,0.02")
    assert read_viewpoints(tmp_path / "cameras.csv").names == NAMES


@pytest.mark.parametrize(
    "text",
    [
        "# Cameras (2)\n# PhotoID, X, Y, Z, Omega, Phi, Kappa, r11\n"
        "a\t1\t2\t3\t10\t20\t30\t0.1\nb\t4\t5\t6\t0\t0\t0\t1\n",
        "imageName X Y Z Omega Phi Kappa\na 1 2 3 10 20 30\nb 4 5 6 0 0 0\n",
        "Label;Kappa;Z;Y;X;Phi;Omega\na;30;3;2;1;20;10\nb;0;6;5;4;0;0\n",
        "a,1,2,3,10,20,30\nb,4,5,6,0,0,0\n",
    ],
)
def test_tables_of_other_programs_are_read(tmp_path, text):
    (tmp_path / "opk.txt").write_text(text)

    found = read_viewpoints(tmp_path / "opk.txt")

    assert (found.names, found.center.tolist()) == (("a", "b"), [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]])
    world_from_image = Rotation.from_euler("XYZ", (10.0, 20.0, 30.0), degrees=True).as_matrix()
    np.testing.assert_allclose(found.rotation[0], np.diag((1.0, -1.0, -1.0)) @ world_from_image.T, atol=1e-12)


def test_positions_alone_are_enough(tmp_path):
    for text in ("name,x,y,z\na,1,2,3\n", "a 1 2 3\n"):
        (tmp_path / "cameras.csv").write_text(text)

        found = read_viewpoints(tmp_path / "cameras.csv", Intrinsics.create(100, 80, 50.0))

        assert (found.rotation, found.field, found.center.tolist()) == (None, None, [[1.0, 2.0, 3.0]])
        assert found.see(torch.zeros(5, 1, 3)).all()


def test_yaw_turns_clockwise_and_pitch_lifts_the_view_forward(tmp_path):
    (tmp_path / "cameras.csv").write_text("name,x,y,z,yaw,pitch,roll\na,0,0,9,90,0,0\nb,0,0,9,90,60,0\n")

    found = read_viewpoints(tmp_path / "cameras.csv", Intrinsics.create(200, 100, 100.0))

    top, ahead = -found.rotation[:, 1], found.rotation[:, 2]
    torch.testing.assert_close(top[0], top.new_tensor((1.0, 0.0, 0.0)), rtol=0.0, atol=1e-12)  # to the east
    torch.testing.assert_close(ahead[1], top.new_tensor((math.sqrt(0.75), 0.0, -0.5)), rtol=0.0, atol=1e-12)
    assert found.field.tolist() == [[-1.0, 1.0, -0.5, 0.5]] * 2


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("", "has no cameras"),
        ("name,x,y\na,1,2\n", "has no column called z"),
        ("name,x,y,z\na,1,2,high\n", "line 2: z is 'high', but must be a number"),
        ("name,x,y,z\na,1,2,3\na,1,2,3\n", "line 3 has the name 'a' of a line before it"),
        ("name,x,y,z\n", "has no cameras"),
    ],
)
def test_what_is_no_table_is_refused_in_one_sentence(tmp_path, text, sentence):
    (tmp_path / "cameras.txt").write_text(text)

    with pytest.raises(SceneError, match=sentence):
        read_viewpoints(tmp_path / "cameras.txt")


SENSOR = """<sensor id="0" label="FC6310" type="frame"><resolution width="400" height="300"/>
<calibration type="frame" class="adjusted"><resolution width="400" height="300"/><f>200</f><cx>10</cx><cy>-5</cy>
{more}</calibration></sensor><sensor id="1" label="other" type="frame"/>"""


def xml(cameras, transform="", reference="", more=""):
    """A chunk as Metashape writes it; `cameras`: world_from_cam in its frame."""
    rows = "".join(
        f'<camera id="{i}" sensor_id="{i % 2}" component_id="0" label="{i}.JPG"><transform>'
        f"{' '.join(map(repr, matrix.ravel().tolist()))}</transform></camera>"
        for i, matrix in enumerate(cameras)
    )
    lost = '<camera id="9" sensor_id="0" label="lost.JPG"/>'
    ones = " ".join(["1"] * 16)
    off = f'<camera id="8" sensor_id="0" enabled="false" label="off.JPG"><transform>{ones}</transform></camera>'
    return (
        '<?xml version="1.0"?><document version="2.0.0"><chunk label="Chunk 1">'
        f"<sensors>{SENSOR.format(more=more)}</sensors>"
        f'<components><component id="0">{transform}</component></components><cameras>{rows}'
        f'<group id="0">{lost}{off}</group></cameras>{reference}</chunk></document>'
    )


def matrices(rotations, centers):
    """world_from_cam of four rows."""
    found = np.tile(np.eye(4), (len(centers), 1, 1))
    found[:, :3, :3], found[:, :3, 3] = rotations.transpose(0, 2, 1), centers
    return found


def similarity(scale, rotation, shift):
    numbers = (" ".join(map(repr, np.ravel(values).tolist())) for values in (rotation, shift))
    turned, moved = numbers
    return (
        f'<transform><rotation locked="true">{turned}</rotation><translation>{moved}</translation>'
        f"<scale>{scale!r}</scale></transform>"
    )


@pytest.mark.parametrize("reference", ["", '<reference>LOCAL_CS["Local Coordinates (m)",UNIT["metre",1]]</reference>'])
def test_metashape_in_a_local_frame(tmp_path, draw, reference):
    rotations, centers, turn = (
        draw.rotations(4).numpy(),
        draw.uniform(-1.0, 1.0, 4, 3).numpy(),
        draw.rotations(1)[0].numpy(),
    )
    chunk = similarity(12.5, turn, (1.0, 2.0, 3.0))
    (tmp_path / "cameras.xml").write_text(xml(matrices(rotations, centers), chunk, reference))

    found = read_viewpoints(tmp_path / "cameras.xml")

    assert (found.names, found.crs) == (tuple(f"{i}.JPG" for i in range(4)), None)
    np.testing.assert_allclose(found.center, 12.5 * centers @ turn.T + (1.0, 2.0, 3.0), atol=1e-12)
    np.testing.assert_allclose(found.rotation, rotations @ turn.T, atol=1e-12)
    assert found.field[0].tolist() == pytest.approx([-1.05, 0.95, -0.725, 0.775])
    assert found.field[1].isinf().all()


def test_what_distortion_leaves_of_a_photograph_is_its_field(tmp_path, draw):
    pose = matrices(draw.rotations(1).numpy(), np.zeros((1, 3)))
    (tmp_path / "cameras.xml").write_text(xml(pose, more="<k1>-0.1</k1><p1>0.001</p1>"))

    left, right, top, bottom = read_viewpoints(tmp_path / "cameras.xml").field[0].tolist()

    assert left < -1.05
    assert right > 0.95
    assert top < -0.725
    assert bottom > 0.775


def test_metashape_on_earth_stands_on_the_map(tmp_path, draw):
    pyproj = pytest.importorskip("pyproj")
    onto = pyproj.Transformer.from_crs("EPSG:4979", "EPSG:32633", always_xy=True)
    geocentric = pyproj.Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)
    longitude, latitude, height = np.array((14.01, 14.02)), np.array((47.5, 47.51)), np.array((450.0, 460.0))
    earth = np.stack(geocentric.transform(longitude, latitude, height), axis=-1)
    rotations, scale, turn = [], 4.0, draw.rotations(1)[0].numpy()
    for lon, lat in zip(longitude, latitude, strict=True):
        lam, phi = math.radians(lon), math.radians(lat)
        east = (-math.sin(lam), math.cos(lam), 0.0)
        up = (math.cos(phi) * math.cos(lam), math.cos(phi) * math.sin(lam), math.sin(phi))
        north = np.cross(up, east)
        rotations.append(np.stack((east, -north, -np.array(up))))  # looks down, its top to true north
    in_chunk = matrices(np.array(rotations) @ turn, (earth - earth[0]) @ turn / scale)
    chunk = similarity(scale, turn, earth[0])
    wkt = pyproj.CRS("EPSG:4326").to_wkt("WKT1_GDAL").replace('"', "&quot;")
    (tmp_path / "cameras.xml").write_text(xml(in_chunk, chunk, f"<reference>{wkt}</reference>"))

    found = read_viewpoints(tmp_path / "cameras.xml", crs="EPSG:32633")

    easting, northing = onto.transform(longitude, latitude)
    np.testing.assert_allclose(found.center, np.stack((easting, northing, height), axis=-1), atol=1e-4)
    assert "UTM zone 33N" in str(found.crs)
    convergence = [pyproj.Proj("EPSG:32633").get_factors(*place).meridian_convergence for place in
                   zip(longitude, latitude, strict=True)]  # fmt: skip
    top = -found.rotation[:, 1]
    np.testing.assert_allclose(torch.atan2(top[:, 0], top[:, 1]).rad2deg(), -np.array(convergence), atol=1e-3)
    np.testing.assert_allclose(found.rotation[:, 2], [[0.0, 0.0, -1.0]] * 2, atol=1e-5)
    with pytest.raises(SceneError, match="has cameras in WGS 84, which is no map; give the projected one"):
        read_viewpoints(tmp_path / "cameras.xml")


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("<document>", "is not valid XML"),
        ("<document/>", "has no chunk"),
        (xml([]), "has no aligned camera"),
        (xml([np.eye(3)]), "must be 16 finite numbers"),
        (xml([np.eye(4)]).replace("<f>200</f>", "<f>wide</f>"), "f of calibration '' must be 1 finite numbers"),
        (xml([np.eye(4)]).replace('width="400"', 'width="0"'), "sensor 'FC6310' cannot be right"),
    ],
)
def test_xml_that_cannot_be_right_is_refused_in_one_sentence(tmp_path, text, sentence):
    (tmp_path / "cameras.xml").write_text(text)

    with pytest.raises(SceneError, match=sentence):
        read_viewpoints(tmp_path / "cameras.xml")


def test_a_lens_beside_calibrated_cameras_is_refused(tmp_path):
    (tmp_path / "cameras.xml").write_text(xml([np.eye(4)]))

    with pytest.raises(SceneError, match="has calibrated cameras; leave out camera, focal_px and size"):
        read_viewpoints(tmp_path / "cameras.xml", Intrinsics.create(100, 80, 50.0))
