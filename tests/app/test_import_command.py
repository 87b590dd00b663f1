"""`torchrefrac import` as a person uses it: from a folder of photographs to a capture."""

import json
import shutil

import cv2
import numpy as np
import pytest

from tests.files.metadata import oracle
from tests.files.metadata.made_photographs import gps, packet, write_photograph
from torchrefrac import load_capture

DJI = {"Make": "DJI", "Model": "FC6310", "FocalLength": (88, 10)}
FLIGHT = [(44.0, -90.0, 0.0), (44.0, -70.0, 1.0), (224.0, -85.0, 180.0)]  # yaw, pitch, roll


def xmp(yaw, pitch, roll, i, **others):
    return packet(
        drone_dji__GimbalYawDegree=f"{yaw:+.2f}", drone_dji__GimbalPitchDegree=f"{pitch:+.2f}",
        drone_dji__GimbalRollDegree=f"{roll:+.2f}", drone_dji__GpsLatitude=f"{46.8422 + 1e-4 * i:+.7f}",
        drone_dji__GpsLongitude="-91.9940000", drone_dji__AbsoluteAltitude=f"{230.0 + i:+.2f}",
        drone_dji__RelativeAltitude=f"{40.0 + i:+.2f}", **others,
    )  # fmt: skip


@pytest.fixture
def flight(tmp_path):
    """Three photographs of a drone."""
    folder = tmp_path / "DCIM" / "100MEDIA"
    for i, angles in enumerate(FLIGHT):
        write_photograph(folder / f"DJI_000{i}.JPG", DJI, xmp(*angles, i), seed=i)
    return folder


@pytest.fixture
def read(tmp_path):
    """`read("river")`: the capture.json and import.json in that folder; the former is one that can be loaded."""

    def of(name):
        load_capture(tmp_path / name)
        return [json.loads((tmp_path / name / file).read_text()) for file in ("capture.json", "import.json")]

    return of


def contents(folder):
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_a_flight_becomes_a_capture(torchrefrac, flight, read, tmp_path):
    before = contents(flight)

    ended = torchrefrac("import", "photos=DCIM", "out=river")

    assert (ended.status, ended.err.count("error")) == (0, 0)
    assert max(map(len, ended.out.splitlines())) <= 100
    assert "gimbal (XMP drone-dji)" in ended.out
    capture, report = read("river")
    assert (capture["format"], capture["length_unit"], capture["folder"]) == (
        "torchrefrac-capture/2",
        "m",
        "../DCIM/100MEDIA",
    )
    (name,) = capture["cameras"]
    assert capture["cameras"][name] == {
        "model": "opencv", "width": 96, "height": 72, "fx": 64.0, "fy": 64.0, "cx": 48.0, "cy": 36.0,
        "distortion": [0.0] * 5, "sigma": {"focal": 0.05, "principal_point": 0.96, "distortion": 0.05},
    }  # fmt: skip
    for image, angles in zip(capture["images"], FLIGHT, strict=True):
        axes = oracle.camera_axes(*angles)
        assert image["down_in_cam"] == pytest.approx(oracle.down_in_cam(axes), abs=1e-6)
        heading = (oracle.heading_deg(axes) - 0.7338) % 360.0  # 1.006 degrees east of the middle of the zone
        assert image["heading_deg"] == pytest.approx(heading, abs=2e-3)
        assert "height" not in image
    positions = np.array([image["position"] for image in capture["images"]])
    assert np.linalg.norm(np.diff(positions, axis=0), axis=1) == pytest.approx([11.157, 11.157], abs=0.02)
    assert capture["georeference"]["crs"] == "EPSG:32615"
    assert capture["georeference"]["vertical"] == "sea level"
    assert report["position"] == {"XMP drone-dji": 3}
    assert contents(flight) == before
    loaded = load_capture(tmp_path / "river")
    assert loaded.paths[0].samefile(flight / "DJI_0000.JPG")
    assert loaded.position_sigma.tolist() == [[1.5, 1.5, 3.0]] * 3
    assert loaded.cameras.focal_sigma.tolist() == [0.05]
    assert loaded.has_gravity
    assert not loaded.has_height.any()
    assert loaded.georeference.vertical == "sea level"


def test_the_same_again_gives_the_same_bytes(torchrefrac, flight, tmp_path):
    torchrefrac("import", "photos=DCIM", "out=river")
    first = contents(tmp_path / "river")

    assert torchrefrac("import", "photos=DCIM", "out=river").status == 0
    assert contents(tmp_path / "river") == first
    assert {path.name for path in first} == {"capture.json", "import.json"}


def test_another_import_takes_the_place_of_the_one_before(torchrefrac, flight, read):
    torchrefrac("import", "photos=DCIM", "out=river")

    assert torchrefrac("import", "photos=DCIM", "out=river", "water_level=200").status == 0
    assert [image["height"] for image in read("river")[0]["images"]] == [30.0, 31.0, 32.0]


def test_a_capture_that_somebody_changed_is_not_replaced(torchrefrac, flight, tmp_path):
    torchrefrac("import", "photos=DCIM", "out=river")
    path = tmp_path / "river" / "capture.json"
    path.write_text(path.read_text().replace("1.333", "1.34"))
    before = contents(tmp_path)

    ended = torchrefrac("import", "photos=DCIM", "out=river")

    assert ended.status == 1
    assert "capture.json was not written by import, or has been changed since" in ended.err
    assert contents(tmp_path) == before


@pytest.mark.parametrize("out", ["DCIM/100MEDIA", "DCIM/100MEDIA/river"])
def test_nothing_is_written_among_the_photographs(torchrefrac, flight, tmp_path, out):
    before = contents(tmp_path)

    ended = torchrefrac("import", "photos=DCIM", f"out={out}")

    assert ended.status == 1
    assert "where photographs lie; name a folder outside theirs" in ended.err
    assert contents(tmp_path) == before
    assert not (tmp_path / "DCIM" / "100MEDIA" / "river").exists()


@pytest.mark.parametrize(
    ("option", "heights", "sigma"),
    [("water_level=199.5", [30.5, 31.5, 32.5], 3.0), ("take_off_above_water=2", [42.0, 43.0, 44.0], 0.5)],
)
def test_heights_follow_from_what_the_user_knows_of_the_water(torchrefrac, flight, read, option, heights, sigma):
    torchrefrac("import", "photos=DCIM", "out=river", option)

    images = read("river")[0]["images"]
    assert [image["height"] for image in images] == heights
    assert {image["height_sigma"] for image in images} == {sigma}


def test_options_take_the_place_of_what_files_say(torchrefrac, flight, read):
    options = ("focal_px=80", "gravity_sigma_deg=2", "position_sigma=[0.5,0.7]", "crs=EPSG:26915", "vertical=take_off")
    torchrefrac("import", "photos=DCIM", "out=river", *options, "index_ratio=1.34")

    capture = read("river")[0]
    (camera,) = capture["cameras"].values()
    assert (camera["fx"], camera["sigma"]["focal"]) == (80.0, 0.02)
    assert capture["down_in_cam_sigma_deg"] == 2.0
    assert capture["position_sigma"] == [0.5, 0.5, 0.7]
    assert capture["georeference"]["crs"] == "EPSG:26915"
    assert capture["georeference"]["vertical"] == "take-off"
    assert [image["position"][2] for image in capture["images"]] == [40.0, 41.0, 42.0]
    assert capture["index_ratio"] == 1.34


def test_a_table_takes_the_place_of_what_files_say(torchrefrac, flight, read, tmp_path):
    columns, row = "name,x,y,z,down_x,down_y,down_z,height,camera", "DJI_0001,576700,5188120,231,0,3,4,31,left"
    (tmp_path / "known.csv").write_text(f"{columns}\n{row}\n")

    ended = torchrefrac("import", "photos=DCIM", "out=river", "table=known.csv", "crs=EPSG:32615", "vertical=auto")

    assert ended.status == 0, ended.err
    capture, report = read("river")
    first, second, third = capture["images"]
    origin = capture["georeference"]["origin"]
    assert second["down_in_cam"] == [0.0, 0.6, 0.8]
    assert (second["height"], second["camera"]) == (31.0, "left")
    assert set(capture["cameras"]) == {"left", first["camera"]}
    assert "position" not in second  # its altitude is that of the table, the others' that of the sea
    assert "table" in report["without_position"]["DJI_0001.JPG"]
    assert all(float(part).is_integer() for part in origin)
    assert "heading_deg" not in second
    assert "heading_deg" in third


def test_rtk_among_others_has_its_own_sigma_and_other_levels_are_told(torchrefrac, flight, read):
    rtk = {f"drone_dji__RtkStd{axis}": "0.01" for axis in ("Lon", "Lat", "Hgt")}
    for i in (3, 4, 5, 6):
        others = rtk | {"drone_dji__RtkFlag": "50"}
        write_photograph(flight / f"DJI_000{i}.JPG", DJI, xmp(44.0, -90.0, 0.0, i, **others), seed=i)

    ended = torchrefrac("import", "photos=DCIM", "out=river")

    capture, report = read("river")
    assert capture["position_sigma"] == [0.015, 0.015, 0.015]
    assert capture["georeference"]["vertical"] == "ellipsoid"
    assert sum("position" in image for image in capture["images"]) == 4
    assert set(report["without_position"]) == {f"DJI_000{i}.JPG" for i in range(3)}
    assert "counted from the sea level and take-off, those of others from the ellipsoid" in " ".join(ended.out.split())
    torchrefrac("import", "photos=DCIM", "out=river", "vertical=take_off")
    capture = read("river")[0]
    assert [image.get("position_sigma") for image in capture["images"]] == [[1.5, 1.5, 3.0]] * 3 + [None] * 4


def test_photographs_that_say_nothing_make_a_capture_and_a_list_of_what_is_missing(torchrefrac, tmp_path, read):
    for i in range(2):
        write_photograph(tmp_path / "photos" / f"{i}.png", seed=i)

    ended = torchrefrac("import", "photos=photos", "out=river")

    assert ended.status == 0
    said = " ".join(ended.out.split())
    assert "0.png and 1 others have neither EXIF nor XMP: say what you know by camera= or focal_px=" in said
    assert "the focal length of 2 photographs is a guess" in said
    capture, _ = read("river")
    assert set(capture["images"][0]) == {"name", "camera"}
    assert not {"down_in_cam_sigma_deg", "position_sigma", "georeference"} & set(capture)
    (camera,) = capture["cameras"].values()
    assert (camera["fx"], camera["sigma"]["focal"]) == (115.2, 0.3)


def test_a_lens_that_bends_lines_is_told(torchrefrac, tmp_path):
    for i in range(2):
        write_photograph(tmp_path / "photos" / f"{i}.jpg", {"Make": "GoPro", "FocalLengthIn35mmFilm": 16}, seed=i)

    ended = torchrefrac("import", "photos=photos", "out=river")

    assert "bends straight lines, which no tag describes: calibrate it" in " ".join(ended.out.split())


def test_what_is_left_out_is_named_with_its_reason(torchrefrac, flight, read):
    write_photograph(flight / "DJI_0010_T.JPG", DJI, seed=10)
    write_photograph(flight / "DJI_0011.JPG", DJI, xmp(44.0, -90.0, 0.0, 3), seed=11)
    (flight / "DJI_0012.JPG").write_bytes((flight / "DJI_0011.JPG").read_bytes()[:-300])
    (flight / "DJI_0011.DNG").write_bytes(b"raw")
    (flight / "DJI_0013.HEIC").write_bytes(b"heic")
    cv2.imwrite(str(flight / "DJI_0014.JPG"), np.zeros((72, 96), dtype=np.uint8))
    write_photograph(flight / "PANO_0001.JPG", {}, packet(GPano__ProjectionType="cylindrical"), seed=13)

    ended = torchrefrac("import", "photos=DCIM", "out=river")

    capture, report = read("river")
    assert [image["name"] for image in capture["images"]] == [f"DJI_00{i}.JPG" for i in ("00", "01", "02", "11")]
    words = {"DJI_0010_T.JPG": "thermal", "DJI_0011.DNG": "raw data", "DJI_0012.JPG": "is damaged",
             "DJI_0013.HEIC": "heif-convert", "DJI_0014.JPG": "black", "PANO_0001.JPG": "panorama"}  # fmt: skip
    assert set(report["left_out"]) == set(words)
    assert all(word in report["left_out"][name] for name, word in words.items())
    assert all(name in ended.out for name in words)
    torchrefrac("import", "photos=DCIM", "out=river", "look=false")
    assert "DJI_0014.JPG" not in read("river")[1]["left_out"]


def test_photographs_without_a_fix_among_others_have_no_position(torchrefrac, flight, read):
    write_photograph(flight / "DJI_0007.JPG", DJI | gps(0.0, 0.0, 0.0), seed=7)

    torchrefrac("import", "photos=DCIM", "out=river")

    capture, report = read("river")
    assert ["position" in image for image in capture["images"]] == [True, True, True, False]
    assert ["down_in_cam" in image for image in capture["images"]] == [True, True, True, False]
    assert report["without_position"] == {"DJI_0007.JPG": "no position"}


def test_a_camera_that_looks_at_the_sky_has_no_gravity(torchrefrac, flight, read):
    write_photograph(flight / "DJI_0007.JPG", DJI, xmp(44.0, 5.0, 0.0, 3), seed=7)

    ended = torchrefrac("import", "photos=DCIM", "out=river")

    assert "DJI_0007.JPG: it looks at the horizon or above by its gravity; that is not used" in ended.out
    assert "down_in_cam" not in read("river")[0]["images"][3]


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["photos=nowhere"], "photos is nowhere, where no file is; name the folder with the photographs"),
        (["photos=empty"], "photos is empty, where no file is"),
        (["photos=one"], "where 1 photograph can be used, but a reconstruction needs two"),
        (["photos=DCIM", "water_level=500"], "would be -270.00 m above the water by water_level"),
        (["photos=DCIM", "crs=EPSG:4326"], "crs 'EPSG:4326' has no axes in metres"),
        (["photos=DCIM", "table=nothing.csv"], "nothing.csv does not exist, but table must be a CSV file"),
        (["photos=DCIM", "camera=nothing.json"], "nothing.json does not exist, but camera must be a file"),
        (["photos=DCIM", "table=cameras.csv"], "JPG is 96x72, but others of camera 'left' are 72x96; name another"),
        (["photos=DCIM", "index_ratio=0.5"], "index_ratio is 0.5, but must lie between 1 and 3"),
        (["photos=DCIM", "position_sigma=[1,2,3]"], "position_sigma is [1.0, 2.0, 3.0], but must be two"),
        (["photos=DCIM", "vertical=up"], "vertical is 'up', but must be one of auto, ellipsoid"),
        (["photos=DCIM", "hight=3"], "hight"),
        ([], "photos is missing"),
    ],
)
def test_bad_input_is_one_sentence_and_leaves_nothing(torchrefrac, flight, tmp_path, arguments, sentence):
    (tmp_path / "empty").mkdir()
    write_photograph(tmp_path / "one" / "a.jpg", DJI)
    write_photograph(flight / "b.jpg", DJI, size=(72, 96))
    (tmp_path / "cameras.csv").write_text("name,camera\nDJI_0000,left\nb,left\n")

    ended = torchrefrac("import", *arguments, "out=river")

    assert ended.status == 1
    assert sentence in ended.err
    assert "Traceback" not in ended.err
    assert not (tmp_path / "river").exists()


def test_quiet_says_nothing(torchrefrac, flight):
    ended = torchrefrac("import", "photos=DCIM", "out=river", "-q")

    assert (ended.status, ended.out, ended.err) == (0, "", "")


def test_names_of_folders_may_be_anything(torchrefrac, flight, tmp_path, read):
    shutil.move(tmp_path / "DCIM", tmp_path / "Überflug (1)")
    shutil.copytree(tmp_path / "Überflug (1)", tmp_path / "H=40m")

    assert torchrefrac("import", "photos=Überflug (1)", "out=2024").status == 0
    assert torchrefrac("import", "photos=[Überflug (1),H=40m]", "out=both").status == 0
    assert len(read("both")[0]["images"]) == 6
    assert torchrefrac("import", "photos=H=40m/*/*1.JPG,", "out=none").status == 1
