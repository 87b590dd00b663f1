"""Numbers of lenses that no lens has are refused, in every file."""

import pytest

from torchrefrac import load_capture
from torchrefrac.camera import Intrinsics
from torchrefrac.files.colmap.tables import intrinsics_of
from torchrefrac.files.colmap.text import CAMERAS_HEAD
from torchrefrac.files.colmap.text import read_cameras as read_rows
from torchrefrac.files.plausible import implausible
from torchrefrac.scene import CaptureError, SceneError

NO_DISTORTION = (0.0, 0.0, 0.0, 0.0, 0.0)


@pytest.mark.parametrize(
    ("focal", "center", "distortion"),
    [
        ((32.0, 32.0), (320.0, 240.0), NO_DISTORTION),  # 169 degrees
        ((640_000.0, 500_000.0), (320.0, 240.0), NO_DISTORTION),
        ((500.0, 500.0), (0.0, 480.0), NO_DISTORTION),  # one corner of a photograph that was cut
        ((500.0, 500.0), (320.0, 240.0), (-0.4, 0.2, 0.01, 0.01, -0.1)),
        ((8000.0, 8000.0), (320.0, 240.0), (0.1, 20.0, 0.0, 0.0, 1e4)),  # a long lens
    ],
)
def test_lenses_there_are_are_taken(focal, center, distortion):
    assert implausible(Intrinsics.create(640, 480, focal, center, distortion)) is None


@pytest.mark.parametrize(
    ("focal", "center", "distortion", "name"),
    [
        ((31.0, 500.0), (320.0, 240.0), NO_DISTORTION, "fx"),
        ((500.0, 1e6), (320.0, 240.0), NO_DISTORTION, "fy"),
        ((500.0, 500.0), (-0.1, 240.0), NO_DISTORTION, "cx"),
        ((500.0, 500.0), (320.0, 480.1), NO_DISTORTION, "cy"),
        ((500.0, 500.0), (320.0, 240.0), (100.0, 0.0, 0.0, 0.0, 0.0), "distortion"),
        ((500.0, 500.0), (320.0, 240.0), (0.0, 0.0, 0.0, 1e308, 0.0), "distortion"),
    ],
)
def test_what_is_not_is_named(focal, center, distortion, name):
    found, _ = implausible(Intrinsics.create(640, 480, focal, center, distortion))

    assert found == name


def test_the_file_and_the_field_are_named(write_capture):
    folder = write_capture(lambda content: content["intrinsics"].update(fx=3.1))

    sentence = r"capture.json: intrinsics.fx is 3.1, but with images 64 pixels long must lie between 3.2 and 64000"
    with pytest.raises(CaptureError, match=sentence):
        load_capture(folder)


def test_so_is_the_camera_of_a_colmap_model(tmp_path):
    path = tmp_path / "cameras.txt"
    path.write_text(f"{CAMERAS_HEAD}7 PINHOLE 640 480 500 500 320 500\n")

    sentence = (
        r"cameras.txt: camera 7: cy is 500 from the edge, but the principal point must lie in the image, which has 480"
    )
    with pytest.raises(SceneError, match=sentence):
        intrinsics_of(read_rows(path)[0], path)


@pytest.mark.parametrize("height", [1e-10, 1e10])
def test_heights_whose_powers_have_no_exponent_are_refused(write_capture, height):
    folder = write_capture(lambda content: content["images"][0].update(height=height))

    with pytest.raises(CaptureError, match=r"images\[0\].height is .*, but must lie between 1e-09 and 1e\+09"):
        load_capture(folder)
