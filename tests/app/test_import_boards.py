"""Boards and tags that lie under water: their corners are found where bent rays have them, and make a survey."""

import json

import cv2
import numpy as np
import pytest
import torch

from tests.files.metadata.sunken_boards import CHARUCO, CHECKER, CHESSBOARD, SQUARE, TAG, sunken
from tests.planted_reconstructions import plant_reconstruction
from torchrefrac import FlatInterface, RefractiveCamera, load_capture, read_scene, read_survey
from torchrefrac.config import OptionError
from torchrefrac.config.importing import CalibrateOptions, ImportOptions, length_in_m
from torchrefrac.files.colmap.model import write_colmap
from torchrefrac.files.metadata.board_survey import survey_of
from torchrefrac.files.metadata.boards import Charuco, Chessboard, Sighting, Tags
from torchrefrac.files.survey import write_survey
from torchrefrac.geometry import Similarity
from torchrefrac.scene import CaptureError
from torchrefrac.sfm.frame import transformed

BOARDS = {
    "charuco": Charuco(*CHARUCO, SQUARE),
    "chessboard": Chessboard(*CHESSBOARD, CHECKER),
    "apriltag": Tags("tag36h11", TAG),
}
OPTIONS = {
    "charuco": ("board=charuco", "columns=6", "rows=5", "square=80mm", "marker=5.6cm"),
    "chessboard": ("board=chessboard", "columns=6", "rows=5", "square=40mm"),
    "apriltag": ("board=apriltag", "tag=0.12m"),
}


@pytest.fixture(scope="module")
def scene():
    return sunken()


@pytest.fixture(scope="module")
def photographs(made_once, scene):
    """Folder with a photograph from each camera."""

    def make(folder):
        for i, picture in enumerate(scene.photographs()):
            cv2.imwrite(str(folder / f"{i}.png"), picture)

    return made_once("sunken_boards", make)


@pytest.mark.parametrize("kind", BOARDS)
def test_corners_are_found_where_bent_rays_have_them(scene, photographs, kind):
    names = set()
    for i in range(4):
        seen, twice = BOARDS[kind].find(photographs / f"{i}.png")
        assert not twice
        for one in seen:
            names.add(one.name)
            place = one.place
            if kind == "chessboard":  # OpenCV begins at the other end, in every photograph
                place = CHECKER * np.array((CHESSBOARD[0] - 1, CHESSBOARD[1] - 1, 0.0)) - place
            where = kind if one.name == "board" else one.name
            truth = [scene.pixels(where, corner)[i].tolist() for corner in place]
            off = np.linalg.norm(one.pixels + 0.5 - np.array(truth), axis=-1)
            assert np.median(off) < (0.2 if kind == "chessboard" else 0.05)
            assert off.max() < 0.5
    assert names == ({"tag 3", "tag 7"} if kind == "apriltag" else {"board"})


@pytest.mark.parametrize(("kind", "corners", "bars"), [("charuco", 20, 6), ("chessboard", 30, 6), ("apriltag", 8, 12)])
def test_import_writes_a_survey_of_the_corners(torchrefrac, photographs, tmp_path, kind, corners, bars):
    ended = torchrefrac("import", f"photos={photographs}", "out=tank", "focal_px=500", *OPTIONS[kind])

    assert ended.status == 0, ended.err
    names = load_capture(tmp_path / "tank").names
    survey = read_survey(tmp_path / "tank" / "survey.json", names)
    assert (len(survey.control_names), len(survey.bar_length)) == (corners, bars)
    assert (survey.skipped, survey.skipped_controls) == ((), ())
    assert len(survey.known_control) == len(survey.center) == 0
    sides = {
        "charuco": (0.24, 0.32, 0.4),
        "chessboard": (0.16, 0.2, 0.256125),
        "apriltag": (TAG, TAG * 2**0.5),
    }[kind]
    assert {round(length, 6) for length in survey.bar_length.tolist()} == {round(side, 6) for side in sides}
    assert survey.bar_sigma.tolist() == pytest.approx([max(0.002 * x, 1e-4) for x in survey.bar_length.tolist()])
    told = json.loads((tmp_path / "tank" / "import.json").read_text())["marks"]
    assert (told["corners"], told["scale_bars"], told["photographs"]) == (corners, bars, 4)
    said = " ".join(ended.out.split())
    assert f"{corners} corners in 4 of 4 {'2 tags' if kind == 'apriltag' else kind}; {bars} scale bars" in said


def test_the_lengths_of_a_tag_give_an_adjustment_its_scale(torchrefrac, make_basin, draw, tmp_path):
    truth = plant_reconstruction(make_basin(cameras=6, points=150, seen_by=3), draw, noise=0.3).truth
    one, nothing = torch.eye(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64)
    write_colmap(transformed(truth, Similarity(truth.points.new_tensor(1.1), one, nothing)), tmp_path / "model")
    pose = truth.views.rotation[:, None], truth.views.center[:, None]
    cameras = RefractiveCamera(truth.cameras[0], *pose, FlatInterface(index_ratio=1.33))
    place = truth.points.new_tensor([[-10.0, 10.0, 0.0], [10.0, 10.0, 0.0], [10.0, -10.0, 0.0], [-10.0, -10.0, 0.0]])
    pixels, valid = cameras.project(place - truth.points.new_tensor([0.0, 0.0, 70.0]))
    assert bool(valid.all())
    tags = {name: [Sighting("tag 5", np.arange(4), *(part.numpy().astype(np.float32) for part in (place, seen - 0.5)))]
            for name, seen in zip(truth.views.names, pixels, strict=True)}  # fmt: skip
    write_survey(survey_of(tags, 0.002), tmp_path / "survey.json")

    ended = torchrefrac("adjust", "alignment=model", "survey=survey.json", "index_ratio=1.33", "out=adjusted")

    assert ended.status == 0, ended.err
    apart = float(torch.pdist(read_scene(tmp_path / "adjusted").views.center).sum())
    assert apart == pytest.approx(float(torch.pdist(truth.views.center).sum()), rel=0.003)


@pytest.mark.slow
def test_photographs_of_a_board_under_water_come_out_in_its_size(torchrefrac, scene, photographs, tmp_path):
    torchrefrac("import", f"photos={photographs}", "out=tank", "focal_px=500", "focal_sigma=0.001", *OPTIONS["charuco"])
    path = tmp_path / "tank" / "capture.json"
    content = json.loads(path.read_text())
    for image, rotation in zip(content["images"], scene.cameras.cam_from_world_rotation, strict=True):
        image["down_in_cam"] = (-rotation[:, 2]).tolist()
    path.write_text(json.dumps(content | {"down_in_cam_sigma_deg": 0.1}))

    torchrefrac("scene=capture", "scene.path=tank", "out=run")
    ended = torchrefrac("adjust", "alignment=run", "survey=tank/survey.json", "out=adjusted")

    assert ended.status == 0, ended.err
    apart = float(torch.pdist(read_scene(tmp_path / "adjusted").views.center).sum())
    assert apart == pytest.approx(float(torch.pdist(scene.cameras.center_in_world).sum()), rel=0.01)


def test_a_tag_that_a_photograph_shows_twice_is_named_and_left_out_there(torchrefrac, photographs, tmp_path):
    (tmp_path / "photos").mkdir()
    for path in photographs.iterdir():
        cv2.imwrite(str(tmp_path / "photos" / path.name), cv2.imread(str(path)))
    seen = BOARDS["apriltag"].find(photographs / "2.png").seen
    x, y = next(one for one in seen if one.name == "tag 7").pixels.mean(axis=0).astype(int)
    picture = cv2.imread(str(photographs / "2.png"))
    picture[-90:, :90] = picture[y - 45 : y + 45, x - 45 : x + 45].copy()
    cv2.imwrite(str(tmp_path / "photos" / "2.png"), picture)

    ended = torchrefrac("import", "photos=photos", "out=tank", *OPTIONS["apriltag"])

    assert "tag 7 is seen more than once in 2.png: nobody knows which is which" in " ".join(ended.out.split())
    marks = json.loads((tmp_path / "tank" / "survey.json").read_text())["marks"]
    assert "2.png" not in marks["tag 7 corner 0"]["observations"]
    assert "2.png" in marks["tag 3 corner 0"]["observations"]


@pytest.mark.parametrize("kind", ["charuco", "chessboard"])
def test_two_equal_boards_in_a_photograph_are_named(photographs, tmp_path, kind):
    picture = cv2.imread(str(photographs / "0.png"))
    cv2.imwrite(str(tmp_path / "two.png"), np.concatenate((picture, picture), axis=1))

    sight = BOARDS[kind].find(tmp_path / "two.png")

    assert sight.twice == ("board",)
    assert sight.certain == []


def test_a_survey_of_somebody_else_stays(torchrefrac, photographs, tmp_path):
    arguments = ("import", f"photos={photographs}", "out=tank")
    (tmp_path / "tank").mkdir()
    survey = tmp_path / "tank" / "survey.json"
    survey.write_text("mine")

    assert torchrefrac(*arguments).status == 0
    ended = torchrefrac(*arguments, *OPTIONS["charuco"])
    assert (ended.status, survey.read_text()) == (1, "mine")
    assert "survey.json was not written by import, or has been changed since" in ended.err
    survey.unlink()
    assert torchrefrac(*arguments, *OPTIONS["charuco"]).status == 0
    assert torchrefrac(*arguments, *OPTIONS["apriltag"]).status == 0
    assert "tag 3 corner 0" in survey.read_text()
    survey.write_text(survey.read_text().replace("pixel_origin", "pixel_origin "))
    changed = survey.read_text()
    assert torchrefrac(*arguments, *OPTIONS["apriltag"]).status == 1
    assert torchrefrac(*arguments).status == 0
    assert survey.read_text() == changed


def test_another_import_without_a_board_takes_its_survey_away(torchrefrac, photographs, tmp_path):
    torchrefrac("import", f"photos={photographs}", "out=tank", *OPTIONS["apriltag"])

    torchrefrac("import", f"photos={photographs}", "out=tank")

    assert not (tmp_path / "tank" / "survey.json").exists()


def test_photographs_without_the_board_make_no_survey(torchrefrac, photographs, tmp_path):
    ended = torchrefrac("import", f"photos={photographs}", "out=tank", "board=apriltag", "tag=1m", "family=DICT_7X7_50")

    assert ended.status == 0
    assert "no apriltag was found in any photograph: check its options" in ended.out
    assert not (tmp_path / "tank" / "survey.json").exists()


def test_scale_bars_lie_between_the_outermost_corners_that_two_photographs_show():
    place = np.array([(x, y, 0) for y in range(3) for x in range(4)], dtype=np.float32)
    pixels = place[:, :2] + np.float32(10.0)
    whole = Sighting("board", np.arange(12), place, pixels)
    part = Sighting("board", np.arange(11), place[:11], pixels[:11])  # without the last corner

    survey = survey_of({"a": [whole], "b": [part]}, 0.01)

    ends = {
        frozenset((survey.control_names[i].split()[-1], survey.control_names[j].split()[-1]))
        for i, j in zip(survey.bar_from.tolist(), survey.bar_to.tolist(), strict=True)
    }
    assert len(survey.control_names) == 11
    assert len(ends) == 6
    assert {end for pair in ends for end in pair} == {"0", "3", "8", "7"}  # 7 and 10 are as far out
    assert survey.bar_sigma.tolist() == pytest.approx([0.01 * length for length in survey.bar_length.tolist()])
    assert survey.control_pixels[0].tolist() == [10.5, 10.5]


@pytest.mark.parametrize(
    ("text", "length"), [("30mm", 0.03), ("3 cm", 0.03), ("0.5m", 0.5), ("1in", 0.0254), (7, 7), (None, None)]
)
def test_lengths_have_units(text, length):
    assert length_in_m("square", text) == (None if length is None else pytest.approx(length))


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"board": "charuco", "columns": 6, "rows": 5}, "square is missing, but board=charuco needs columns, rows, sq"),
        ({"board": "apriltag"}, "tag is missing, but board=apriltag needs tag"),
        ({"board": "apriltag", "tag": 160.0}, "tag is 160, but must have a unit, such as 160mm"),
        ({"board": "apriltag", "tag": "160 feet"}, "tag is '160 feet', but must be a number with a unit"),
        ({"board": "apriltag", "tag": "0mm"}, "tag is 0, but must be finite and above 0"),
        (
            {"board": "charuco", "columns": 6, "rows": 5, "square": "30mm", "marker": "4cm"},
            "marker is 4cm, but must be",
        ),
    ],
)
def test_a_board_that_is_not_whole_is_refused(options, sentence):
    with pytest.raises((OptionError, ValueError), match=sentence):
        ImportOptions(photos="a", out="b", **options)


def test_a_calibration_takes_sides_with_and_without_units():
    known = {"photos": "a", "out": "b", "columns": 6, "rows": 5}
    assert CalibrateOptions(**known, square=30.0).side("square") == 30.0
    assert CalibrateOptions(**known, square="30mm").side("square") == pytest.approx(0.03)


def test_boards_that_nobody_can_tell_are_refused(torchrefrac, photographs, tmp_path):
    even = torchrefrac(
        "import", f"photos={photographs}", "out=tank", "board=chessboard", "columns=7", "rows=5", "square=4cm"
    )

    assert "a chessboard of 7 x 5 inner corners looks the same upside down" in even.err
    assert not (tmp_path / "tank").exists()
    with pytest.raises(CaptureError, match="dictionary 'tag99h1' is none of OpenCV's"):
        Tags("tag99h1", TAG)
