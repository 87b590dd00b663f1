"""`torchrefrac calibrate`: a camera from drawn photographs of a board, and what import makes of it."""

import json
import math

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from torchrefrac.files.metadata.camera_file import read_camera
from torchrefrac.scene import CaptureError

SIZE, FOCAL, CENTER = (640, 480), (520.0, 516.0), (326.0, 233.0)  # the latter as OpenCV counts pixels
DISTORTION = (-0.12, 0.05, 0.001, -0.0008, 0.0)
MATRIX = np.array([[FOCAL[0], 0.0, CENTER[0]], [0.0, FOCAL[1], CENTER[1]], [0.0, 0.0, 1.0]])
SQUARE, PIXELS = 30.0, 40  # side of a square in mm, and in pixels of the drawn board
CHARUCO, CHESSBOARD = (9, 7), (8, 6)
POSES = [(0, 0, 0, 0, 0), (30, 0, 0, 0, 0), (-30, 0, 5, 0, 0), (0, 32, 0, 0, 0), (0, -32, 90, 0, 0),
         (22, 22, 0, 60, 40), (-22, 22, 0, -60, 30), (20, -25, 180, 50, -40), (-25, -20, 0, -50, -30)]  # fmt: skip


def _board(kind):
    """A drawing of the board, and its size in mm."""
    if kind == "charuco":
        words = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
        drawn = cv2.aruco.CharucoBoard(CHARUCO, SQUARE, 0.7 * SQUARE, words).generateImage(
            (CHARUCO[0] * PIXELS, CHARUCO[1] * PIXELS)
        )
        return drawn, CHARUCO
    squares = CHESSBOARD[0] + 1, CHESSBOARD[1] + 1
    odd = np.indices(squares[::-1]).sum(axis=0) % 2
    drawn = np.kron(255 * odd, np.ones((PIXELS, PIXELS))).astype(np.uint8)
    return cv2.copyMakeBorder(drawn, PIXELS, PIXELS, PIXELS, PIXELS, cv2.BORDER_CONSTANT, value=255), (
        squares[0] + 2,
        squares[1] + 2,
    )


def _rays():
    """One of each pixel."""
    pixels = np.stack(np.meshgrid(*(np.arange(float(side)) for side in SIZE)), axis=-1)
    plane = cv2.undistortPoints(pixels.reshape(-1, 1, 2), MATRIX, np.array(DISTORTION)).reshape(-1, 2)
    return np.column_stack((plane, np.ones(len(plane))))


def _photograph(drawn, squares, pose, rays):
    """The board, seen by the camera: every pixel looks up the drawing where its ray meets the plane."""
    tilt_x, tilt_y, turn, x, y = pose
    rotation = Rotation.from_euler("ZYX", (turn, tilt_y, tilt_x), degrees=True).as_matrix()
    middle = 0.5 * SQUARE * np.array((*squares, 0.0))
    shift = np.array((x, y, 460.0)) - rotation @ middle
    normal = rotation[:, 2]
    points = rays * ((normal @ shift) / (rays @ normal))[:, None]
    places = ((points - shift) @ rotation)[:, :2] / SQUARE * PIXELS - 0.5
    x, y = places.astype(np.float32).T.reshape(2, SIZE[1], SIZE[0])
    seen = cv2.remap(drawn, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=200)
    return cv2.GaussianBlur(seen, (0, 0), 0.6)


@pytest.fixture(scope="module")
def boards(made_once):
    """Folder with photographs of both boards, and one without any among those of charuco."""

    def make(folder):
        rays = _rays()
        for kind in ("charuco", "chessboard"):
            drawn, squares = _board(kind)
            (folder / kind).mkdir()
            for i, pose in enumerate(POSES):
                cv2.imwrite(str(folder / kind / f"{i}.png"), _photograph(drawn, squares, pose, rays))
        cv2.imwrite(str(folder / "charuco" / "none.png"), np.full(SIZE[::-1], 127, dtype=np.uint8))

    return made_once("boards", make)


@pytest.mark.parametrize("kind", ["charuco", "chessboard"])
def test_a_board_gives_the_camera_with_its_sigma(torchrefrac, boards, tmp_path, kind):
    columns, rows = CHARUCO if kind == "charuco" else CHESSBOARD
    sides = (f"columns={columns}", f"rows={rows}", f"square={SQUARE}")

    ended = torchrefrac("calibrate", f"photos={boards / kind}", f"board={kind}", *sides, "out=camera.json")

    assert ended.status == 0, ended.err
    _, size, lens = read_camera(tmp_path / "camera.json")
    assert size == SIZE
    assert lens.sigma < 0.01
    assert max(abs(found / true - 1.0) for found, true in zip(lens.focal, FOCAL, strict=True)) < 3.0 * lens.sigma + 1e-3
    assert math.dist(lens.principal_point, (CENTER[0] + 0.5, CENTER[1] + 0.5)) < 3.0 * lens.center_sigma + 0.5
    assert lens.distortion[0] == pytest.approx(DISTORTION[0], abs=0.02)
    told = json.loads((tmp_path / "camera.json").read_text())
    assert told["rms_px"] < 0.2
    assert told["photographs"] == len(POSES)
    assert told["without_board"] == (["none.png"] if kind == "charuco" else [])
    assert ("no board was found in none.png" in ended.out) == (kind == "charuco")
    assert "focal length" in ended.out


def test_import_takes_the_camera(torchrefrac, boards, tmp_path):
    torchrefrac("calibrate", f"photos={boards / 'charuco'}", "columns=9", "rows=7", "square=30", "out=camera.json")

    ended = torchrefrac("import", f"photos={boards / 'chessboard'}", "camera=camera.json", "out=river")

    assert ended.status == 0, ended.err
    (camera,) = json.loads((tmp_path / "river" / "capture.json").read_text())["cameras"].values()
    calibrated = json.loads((tmp_path / "camera.json").read_text())["camera"]
    assert camera == calibrated
    assert set(camera["sigma"]) == {"focal", "principal_point", "distortion"}
    half = read_camera(tmp_path / "camera.json").for_size((320, 240))
    assert half.focal[0] == pytest.approx(0.5 * calibrated["fx"])
    with pytest.raises(CaptureError, match=r"is of photographs of 640x480, but some are 480x640"):
        read_camera(tmp_path / "camera.json").for_size((480, 640))


def test_photographs_from_one_side_say_what_they_leave_open(torchrefrac, boards, tmp_path):
    for i in (0, 1, 2, 3):
        (tmp_path / "few").mkdir(exist_ok=True)
        frame = cv2.imread(str(boards / "charuco" / "0.png"))
        moved = np.roll(frame, (2 * i, 3 * i), axis=(0, 1))
        cv2.imwrite(str(tmp_path / "few" / f"{i}.png"), moved)

    ended = torchrefrac("calibrate", "photos=few", "columns=9", "rows=7", "square=30", "out=camera.json")

    assert ended.status == 0, ended.err
    assert "not determined: the focal length, to" in ended.out
    assert "tilted by 30 degrees" in ended.out


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (("columns=5", "rows=5"), "must be in 4 at least; check board, columns, rows"),
        (("columns=9", "rows=7", "dictionary=DICT_9X9"), "dictionary 'DICT_9X9' is none of OpenCV's"),
        (("columns=20", "rows=20"), "has 50 markers, but a board of 20 x 20 squares has 200"),
        (("columns=9", "rows=7", "marker=31"), "marker is 31, but must be smaller than the square of 30"),
        (("columns=1", "rows=7"), "columns is 1, but must be finite and at least 2"),
        (("columns=9",), "rows is missing"),
        (("columns=9", "rows=7", "board=circles"), "board is 'circles', but must be one of charuco, chessboard"),
    ],
)
def test_a_board_that_cannot_be_right_is_refused(torchrefrac, boards, tmp_path, options, sentence):
    ended = torchrefrac("calibrate", f"photos={boards / 'charuco'}", "square=30", *options, "out=camera.json")

    assert ended.status == 1
    assert sentence in ended.err
    assert "Traceback" not in ended.err
    assert not (tmp_path / "camera.json").exists()
