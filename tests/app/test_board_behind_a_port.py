"""`torchrefrac calibrate capture=...` by a board under water, photographed by a tracer of its own through a port."""

import json

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

SIZE, FOCAL = (640, 480), 520.0
SQUARES, SQUARE, DRAWN = (9, 7), 30.0, 40  # of the board; side of a square in mm and in pixels of the drawing
DISTANCE, GLASS, TILT = 20.0, 6.0, np.radians(1.5)  # of the port, mm
INDICES = (1.0, 1.52, 1.333)
POSES = [(0, 0, 0, 0, 0), (25, 0, 0, 20, 0), (-25, 0, 5, 0, 10), (0, 28, 0, 0, 0), (0, -28, 90, 0, 0),
         (18, 18, 0, 50, 30), (-18, 18, 0, -50, 20), (16, -20, 180, 40, -30), (-20, -16, 0, -40, -20)]  # fmt: skip


def _rays():
    """Where the ray of each pixel enters the water, and its direction there, by Snell's law in vectors."""
    pixels = np.stack(np.meshgrid(*(np.arange(float(side)) + 0.5 for side in SIZE)), axis=-1)
    middle = 0.5 * np.array(SIZE)
    along = np.concatenate(((pixels - middle) / FOCAL, np.ones((*pixels.shape[:2], 1))), axis=-1)
    along /= np.linalg.norm(along, axis=-1, keepdims=True)
    normal = np.array((0.0, np.sin(TILT), -np.cos(TILT)))
    at, depth = np.zeros_like(along), DISTANCE
    for before, after, thickness in zip(INDICES[:-1], INDICES[1:], (GLASS, None), strict=True):
        falling = -(along @ normal)
        at = at + along * ((depth - (-(at @ normal))) / falling)[..., None]
        ratio = before / after
        under = np.sqrt(1.0 - ratio**2 * (1.0 - falling**2))
        along = ratio * along + (ratio * falling - under)[..., None] * normal
        depth += thickness or 0.0
    return at, along


def _photograph(drawn, pose, rays):
    tilt_x, tilt_y, turn, x, y = pose
    rotation = Rotation.from_euler("ZYX", (turn, tilt_y, tilt_x), degrees=True).as_matrix()
    shift = np.array((x, y, 560.0)) - rotation @ (0.5 * SQUARE * np.array((*SQUARES, 0.0)))
    at, along = rays
    normal = rotation[:, 2]
    points = at + along * (((shift - at) @ normal) / (along @ normal))[..., None]
    places = ((points - shift) @ rotation)[..., :2] / SQUARE * DRAWN - 0.5
    x, y = np.moveaxis(places, -1, 0).astype(np.float32)
    seen = cv2.remap(drawn, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=200)
    return cv2.GaussianBlur(seen, (0, 0), 0.6)


@pytest.fixture
def dive(tmp_path):
    """A capture whose port is stated 4 mm too far and square to the axis."""
    words = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    board = cv2.aruco.CharucoBoard(SQUARES, SQUARE, 0.7 * SQUARE, words)
    drawn, rays = board.generateImage((SQUARES[0] * DRAWN, SQUARES[1] * DRAWN)), _rays()
    folder = tmp_path / "dive"
    (folder / "images").mkdir(parents=True)
    for i, pose in enumerate(POSES):
        cv2.imwrite(str(folder / "images" / f"{i}.png"), _photograph(drawn, pose, rays))
    cv2.imwrite(str(folder / "images" / "none.png"), np.full(SIZE[::-1], 127, dtype=np.uint8))
    camera = {"width": SIZE[0], "height": SIZE[1], "fx": FOCAL, "fy": FOCAL, "cx": 320.0, "cy": 240.0}
    layers = [{"index": 1.0}, {"index": 1.52, "thickness": GLASS}, {"index": 1.333}]
    port = {"kind": "port", "layers": layers, "normal_in_cam": [0.0, 0.0, -1.0], "distance": DISTANCE + 4.0}
    content = {
        "format": "torchrefrac-capture/2",
        "length_unit": "mm",
        "pixel_origin": "corner",
        "cameras": {"only": camera},
        "interface": port | {"distance_sigma": 5.0, "tilt_sigma_deg": 2.0},
        "images": [{"name": f"{name}.png"} for name in (*range(len(POSES)), "none")],
    }
    (folder / "capture.json").write_text(json.dumps(content))
    return folder


@pytest.mark.parametrize("square", ["30", "3cm"])
def test_a_board_under_water_shows_where_the_port_is(torchrefrac, dive, metrics, tmp_path, square):
    board = (f"columns={SQUARES[0]}", f"rows={SQUARES[1]}", f"square={square}")

    ended = torchrefrac("calibrate", "capture=dive", *board, "pixel_sigma=0.1", "out=found")

    assert ended.status == 0, ended.err
    found = metrics(tmp_path / "found")
    assert found["images"] == len(POSES)
    assert found["reprojection_rms_px"] < 0.3
    (port,) = found["interfaces"]
    assert abs(-port["offset_mm"] - DISTANCE) < 3.0 * port["sigma"][2] < 6.0
    turned = np.degrees(np.arctan2(port["normal"][1], -port["normal"][2]))
    assert turned == pytest.approx(np.degrees(TILT), abs=max(3.0 * np.degrees(port["sigma"][0]), 0.05))


def test_photographs_without_the_board_are_refused(torchrefrac, dive, tmp_path):
    ended = torchrefrac(
        "calibrate", "capture=dive", "columns=4", "rows=3", "square=30", "dictionary=DICT_7X7_50", "out=x"
    )

    assert ended.status == 1
    assert "no photograph shows a known point" in ended.err
    assert not (tmp_path / "x").exists()
