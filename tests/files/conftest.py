"""Captures on disk, made for one test."""

import json

import cv2
import numpy as np
import pytest

WIDTH, HEIGHT = 64, 48


@pytest.fixture
def capture_content():
    """A valid capture.json of two images."""
    return {
        "format": "torchrefrac-capture/1",
        "length_unit": "cm",
        "index_ratio": 1.333,
        "pixel_origin": "center",
        "intrinsics": {
            "width": WIDTH,
            "height": HEIGHT,
            "fx": 50.0,
            "fy": 51.0,
            "cx": 31.5,
            "cy": 23.5,
            "distortion": [0.1, 0, 0, 0, 0],
        },
        "down_in_cam_sigma_deg": 0.5,
        "images": [
            {"name": "a.png", "down_in_cam": [0.0, 0.6, 0.8], "height": 30.0},
            {"name": "b.png", "down_in_cam": [0.0, 0.0, 1.0]},
        ],
    }


@pytest.fixture
def write_capture(tmp_path, capture_content):
    """Writes capture.json with `change` applied to its content, and its images; returns the folder."""

    def write(change=None):
        if change is not None:
            change(capture_content)
        (tmp_path / "images").mkdir()
        for name in ("a.png", "b.png"):
            cv2.imwrite(str(tmp_path / "images" / name), np.zeros((HEIGHT, WIDTH), dtype=np.uint8))
        (tmp_path / "capture.json").write_text(json.dumps(capture_content))
        return tmp_path

    return write
