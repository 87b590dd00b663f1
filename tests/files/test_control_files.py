"""Ground control from the files that surveyors have, on a map or in the local frame, and levels of the water."""

import json

import pytest
import torch

from torchrefrac.files.metadata.local_frame import Grid
from torchrefrac.files.survey import read_survey, write_survey
from torchrefrac.scene import Georeference, SurveyError

pytest.importorskip("pyproj")
NAMES = ("a.jpg", "b.jpg")
PLACE = Georeference("EPSG:32633", (450000.0, 5300000.0, 0.0), scale=0.9996)
AT = {"P1": (10.0, 20.0, 431.0), "P2": (-30.0, 5.0, 432.0), "check3": (8.0, -12.0, 430.0)}
CLICKS = {("a.jpg", "P1"): (10.5, 20.25), ("b.jpg", "P1"): (11.0, 21.0), ("a.jpg", "P2"): (30.0, 40.0),
          ("a.jpg", "check3"): (50.0, 60.0), ("b.jpg", "check3"): (51.0, 61.0)}  # fmt: skip


def on_map(name, crs="EPSG:32633"):
    """Coordinates of a point, in another system than that of the capture where that is wanted."""
    east, north, height = PLACE.coordinates(torch.tensor(AT[name], dtype=torch.float64)).tolist()
    if crs == "EPSG:4326":
        (latitude,), (longitude,), _ = Grid(PLACE.crs).degrees(
            torch.tensor([[east, north]], dtype=torch.float64).numpy()
        )
        return longitude, latitude, height
    return east, north, height


@pytest.fixture
def write(tmp_path):
    """`write(kind, positions, first)`: a survey of the three points as a file of that kind, with what stands first."""

    def make(kind, positions, first=None):
        path = tmp_path / {"odm": "gcp_list.txt", "csv": "control.csv", "json": "survey.json"}[kind]
        if kind == "odm":
            lines = [f"{' '.join(f'{x:.9f}' for x in positions[point])} {u} {v} {image.upper()} {point}"
                     for (image, point), (u, v) in CLICKS.items()]  # fmt: skip
            path.write_text("\n".join([first or "EPSG:32633", *lines]))
        elif kind == "csv":
            rows = [f"{name},{','.join(f'{x:.9f}' for x in at)},0.02,0.03" for name, at in positions.items()]
            path.write_text("\n".join([*([first] if first else []), "name,x,y,z,sigma_xy,sigma_z", *rows]))
            clicks = [f"{image},{point},{u},{v}" for (image, point), (u, v) in CLICKS.items()]
            (tmp_path / "clicks.csv").write_text("\n".join(["image,name,px,py", *clicks]))
        else:
            marks = {
                name: {
                    "position": list(at),
                    "sigma": [0.02, 0.02, 0.03],
                    "check": name.startswith("check"),
                    "observations": {image: list(uv) for (image, point), uv in CLICKS.items() if point == name},
                }
                for name, at in positions.items()
            }
            content = {"format": "torchrefrac-survey/1", "marks": marks} | ({"crs": first} if first else {})
            path.write_text(json.dumps(content))
        return path

    return make


def require_the_same(survey):
    assert survey.control_names == tuple(AT)
    assert (survey.known_control.tolist(), survey.check_control.tolist()) == ([0, 1], [2])
    local = torch.tensor([*AT.values()], dtype=torch.float64)
    torch.testing.assert_close(survey.known_position, local[:2], rtol=0.0, atol=1e-4)
    torch.testing.assert_close(survey.check_position, local[2:], rtol=0.0, atol=1e-4)
    sigma = torch.linalg.inv(survey.known_information).diagonal(dim1=1, dim2=2).sqrt()
    torch.testing.assert_close(sigma, torch.tensor([[0.02, 0.02, 0.03]] * 2).double())
    pixels = {(NAMES[i], survey.control_names[c]): tuple(uv) for i, c, uv in
              zip(survey.control_image, survey.control, survey.control_pixels.tolist(), strict=True)}  # fmt: skip
    assert pixels == CLICKS


@pytest.mark.parametrize("kind", ["odm", "csv", "json"])
@pytest.mark.parametrize("crs", ["EPSG:32633", "EPSG:4326"])
def test_every_file_says_the_same_in_the_frame_of_the_capture(write, kind, crs):
    path = write(kind, {name: on_map(name, crs) for name in AT}, crs)

    require_the_same(read_survey(path, NAMES, PLACE))


@pytest.mark.parametrize("kind", ["csv", "json"])
def test_without_a_crs_numbers_tell_a_map_from_the_local_frame(write, kind):
    require_the_same(read_survey(write(kind, {name: on_map(name) for name in AT}), NAMES, PLACE))
    require_the_same(read_survey(write(kind, AT), NAMES, PLACE))
    require_the_same(read_survey(write(kind, AT), NAMES))


@pytest.mark.parametrize("crs", ["EPSG:32633", "EPSG:4326"])
def test_a_capture_without_a_place_gets_that_of_the_survey(write, crs):
    survey = read_survey(write("csv", {name: on_map(name, crs) for name in AT}, f"# {crs}"), NAMES)

    place = survey.georeference
    assert place is not None
    assert place.crs == "EPSG:32633"
    assert float(survey.known_position[:, :2].abs().max()) < 100.0
    wanted = torch.tensor([on_map("P1"), on_map("P2")], dtype=torch.float64)
    torch.testing.assert_close(place.coordinates(survey.known_position), wanted, rtol=0.0, atol=1e-4)


def test_points_elsewhere_and_exchanged_axes_are_refused_in_a_sentence(write):
    away = {name: (x + 333e3, y, z) for name, (x, y, z) in ((name, on_map(name)) for name in AT)}
    swapped = {name: (y, x, z) for name, (x, y, z) in ((name, on_map(name)) for name in AT)}

    with pytest.raises(SurveyError, match=r"has positions 33\d km from the photographs, read as EPSG:32633"):
        read_survey(write("odm", away), NAMES, PLACE)
    with pytest.raises(SurveyError, match="has x and y exchanged: x is east"):
        read_survey(write("odm", swapped), NAMES, PLACE)
    with pytest.raises(SurveyError, match="'EPSG:99999' is not known to pyproj"):
        read_survey(write("odm", away, "EPSG:99999"), NAMES, PLACE)


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("1 2 3 4 5 a.jpg", "begins with '1 2 3 4 5 a.jpg', but must with a reference system"),
        ("EPSG:32633\n1 2 3 4 a.jpg", "line 2 has 5 columns"),
        ("EPSG:32633\n1 2 NaN 4 5 a.jpg", "line 2: z is 'NaN', but must be a number"),
        ("EPSG:32633\n1 2 3 4 5 a.jpg P\n1 2 3 4 5 a.jpg P", "line 3: P is clicked twice in a.jpg"),
        ("EPSG:32633\n1 2 3 4 5 a.jpg P\n1 2 4 4 5 b.jpg P", "line 3: P has another position"),
        ("", "is empty"),
    ],
)
def test_a_list_that_cannot_be_right_is_refused_with_its_line(tmp_path, text, problem):
    (tmp_path / "gcp_list.txt").write_text(text)

    with pytest.raises(SurveyError, match=problem):
        read_survey(tmp_path / "gcp_list.txt", NAMES, PLACE)


@pytest.mark.parametrize(
    ("points", "clicks", "problem"),
    [
        ("name,x,y\nP,1,2", "image,name,px,py", "control.csv has no column z"),
        ("name,x,y,z\nP,1,2", "image,name,px,py", "line 2 has 3 columns, but the first line names 4"),
        ("name,x,y,z,sigma\nP,1,2,3,0", "image,name,px,py", "line 2: a sigma is 0"),
        ("name,x,y,z,check\nP,1,2,3,perhaps", "image,name,px,py", "check is 'perhaps', but must be yes or no"),
        ("name,x,y,z\nP,1,2,3\nP,1,2,3", "image,name,px,py", "line 3 has the name 'P' of a line before"),
        ("name,x,y,z\nP,1,2,3", "image,name,px,py\na.jpg,Q,1,2", "has clicks of Q, which is no point of"),
        ("name,x,y,z\nP,1,2,3", None, "clicks.csv does not exist, but must be a CSV file of where the points of"),
    ],
)
def test_tables_that_cannot_be_right_are_refused_with_their_line(tmp_path, points, clicks, problem):
    (tmp_path / "control.csv").write_text(points)
    if clicks is not None:
        (tmp_path / "clicks.csv").write_text(clicks)

    with pytest.raises(SurveyError, match=problem):
        read_survey(tmp_path / "control.csv", NAMES)


def test_gauges_with_a_place_are_read_and_written(tmp_path):
    content = {
        "format": "torchrefrac-survey/1",
        "gauges": {
            "bridge": {"height": 431.0, "sigma": 0.02, "position": [12.0, -3.5]},
            "weir": {"height": 430.9, "sigma": 0.01},
        },
    }
    (tmp_path / "survey.json").write_text(json.dumps(content))

    survey = read_survey(tmp_path / "survey.json", NAMES)

    assert survey.level_sources == ("gauge bridge", "gauge weir")
    assert survey.level_position.tolist() == [[12.0, -3.5, 431.0], [0.0, 0.0, 430.9]]
    assert survey.level_has_place.tolist() == [True, False]
    write_survey(survey, tmp_path / "again.json")
    assert json.loads((tmp_path / "again.json").read_text())["gauges"] == content["gauges"]
    content["gauges"]["weir"]["position"] = [1.0, 2.0, 3.0]
    (tmp_path / "survey.json").write_text(json.dumps(content))
    with pytest.raises(SurveyError, match=r"gauges.weir.position.* must be a list of 2 numbers"):
        read_survey(tmp_path / "survey.json", NAMES)


def test_levels_of_the_water_are_read_and_written(tmp_path):
    content = {
        "format": "torchrefrac-survey/1",
        "water_level": {"height": 430.98, "sigma": 0.01},
        "gauges": {"bridge": {"height": 431.0, "sigma": 0.02, "epoch": "june"}},
        "waterline": [{"points": [[1, 2, 431], [3, 4, 430.9]], "sigma": 0.03}],
    }
    (tmp_path / "survey.json").write_text(json.dumps(content))

    survey = read_survey(tmp_path / "survey.json", NAMES)

    assert survey.level_sources == ("water_level", "gauge bridge", "waterline")
    assert survey.level_epochs == ("", "june", "")
    assert survey.level.tolist() == [0, 1, 2, 2]
    assert survey.level_position.tolist() == [[0, 0, 430.98], [0, 0, 431], [1, 2, 431], [3, 4, 430.9]]
    assert survey.level_has_place.tolist() == [False, False, True, True]
    assert survey.level_sigma.tolist() == [0.01, 0.02, 0.03, 0.03]
    write_survey(survey, tmp_path / "again.json")
    again = read_survey(tmp_path / "again.json", NAMES)
    assert again.level_sources == survey.level_sources
    assert again.level.tolist() == survey.level.tolist()
    assert again.level_position.tolist() == survey.level_position.tolist()
