"""Photographs of a bed under water with boards and tags on it: each pixel looks up the drawing along its bent ray."""

from dataclasses import dataclass

import cv2
import numpy as np
import torch

from torchrefrac import FlatInterface, Intrinsics, RefractiveCamera
from torchrefrac.geometry import heading_rotation, level_rotation, rotate

SIZE, FOCAL, INDEX, DEPTH = (640, 480), 500.0, 1.333, 0.25  # px, px, water, m
FLIP = np.array((1.0, -1.0))  # rows of the drawing go south
BED = (1400, 1100)  # of the bed, in mm and in pixels of its drawing
CHARUCO, CHESSBOARD = (6, 5), (6, 5)  # squares; inner corners
SQUARE, CHECKER, TAG = 0.08, 0.04, 0.12  # sides, m
PLACES = {
    "charuco": (460, 240),
    "chessboard": (560, 800),
    "tag 3": (230, 200),
    "tag 7": (1030, 330),
}  # of first corners


@dataclass(frozen=True)
class Sunken:
    """The drawing, and a camera for each photograph."""

    drawn: np.ndarray
    cameras: RefractiveCamera

    def photographs(self):
        """Grey pictures."""
        x, y = np.meshgrid(*(np.arange(side) + 0.5 for side in SIZE))
        pixels = torch.tensor(np.stack((x, y), axis=-1).reshape(-1, 2))
        for i in range(len(self.cameras.center_in_world)):
            start, direction, _ = self.cameras[i].cast_rays(pixels)
            there = start - (start[:, 2:] + DEPTH) / direction[:, 2:] * direction
            at = 1000.0 * there[:, :2].numpy() * FLIP + 0.5 * np.array(BED) - 0.5
            columns, rows = at.astype(np.float32).T.reshape(2, SIZE[1], SIZE[0])
            seen = cv2.remap(self.drawn, columns, rows, cv2.INTER_LINEAR, borderValue=130)
            yield seen

    def pixels(self, name, place):
        """Where a corner at a place (m) on something of PLACES is seen, for each camera; pixels from the corner."""
        at = (0.001 * np.array(PLACES[name]) + np.asarray(place)[:2] - 0.0005 * np.array(BED)) * FLIP
        return self.cameras.project(torch.tensor([*at.tolist(), -DEPTH], dtype=torch.float64))[0]


def sunken():
    """Boards and tags beside each other, seen from four sides."""
    random = np.random.default_rng(5)
    drawn = sum(30.0 * size * cv2.GaussianBlur(random.normal(size=BED[::-1]), (0, 0), size) for size in (1.5, 3, 8, 20))
    drawn = (130 + drawn).clip(0, 255).astype(np.uint8)
    words, tags = (cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{name}"))
                   for name in ("4X4_50", "APRILTAG_36h11"))  # fmt: skip
    side = round(1000 * SQUARE)
    board = cv2.aruco.CharucoBoard(CHARUCO, SQUARE, 0.7 * SQUARE, words)
    _put(drawn, board.generateImage((CHARUCO[0] * side, CHARUCO[1] * side)), PLACES["charuco"])
    odd = np.indices((CHESSBOARD[1] + 1, CHESSBOARD[0] + 1)).sum(axis=0) % 2
    side = round(1000 * CHECKER)
    checkers = np.kron(255 * odd, np.ones((side, side))).astype(np.uint8)
    _put(drawn, checkers, np.array(PLACES["chessboard"]) - side)
    for number in (3, 7):
        _put(drawn, cv2.aruco.generateImageMarker(tags, number, round(1000 * TAG)), PLACES[f"tag {number}"])
    heading = torch.arange(4, dtype=torch.float64) * 1.6
    tilts = [[0.0, 0.0, 1.0], [0.0, 0.25, 1.0], [0.2, 0.1, 1.0], [-0.2, 0.15, 1.0]]
    down = torch.nn.functional.normalize(torch.tensor(tilts, dtype=torch.float64), dim=-1)
    rotation = level_rotation(down) @ heading_rotation(heading)
    ahead = rotate(rotation.mT, torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64))
    center = torch.tensor([0.0, 0.0, 0.9], dtype=torch.float64) - 1.2 * torch.nn.functional.pad(ahead[:, :2], (0, 1))
    intrinsics = Intrinsics.create(*SIZE, focal=FOCAL)
    drawn = cv2.GaussianBlur(drawn, (0, 0), 1.5)  # it is looked up every other pixel
    return Sunken(drawn, RefractiveCamera(intrinsics, rotation, center, FlatInterface(index_ratio=INDEX)))


def _put(drawn, picture, place):
    """With a white margin; the corner of the picture at a place in mm."""
    (x, y), margin = place, 20
    framed = cv2.copyMakeBorder(picture, *4 * (margin,), cv2.BORDER_CONSTANT, value=255)
    drawn[y - margin : y - margin + framed.shape[0], x - margin : x - margin + framed.shape[1]] = framed
