"""Focal lengths, principal points and distortion, from the best that a file says."""

import pytest

from tests.files.metadata.made_photographs import packet, write_photograph
from torchrefrac.files.metadata.photograph import read_photograph

DEWARP = "2022-06-08;80.5,80.25,0.5,-0.75,-0.11,0.012,0.0004,-0.0003,-0.027"
CALIBRATED = {"drone_dji__CalibratedFocalLength": "81.0", "drone_dji__CalibratedOpticalCenterX": "48.5",
              "drone_dji__CalibratedOpticalCenterY": "36.25"}  # fmt: skip
NONE, MIDDLE = (0.0,) * 5, (48.0, 36.0)
OF_DEWARP = (-0.11, 0.012, 0.0004, -0.0003, -0.027)


@pytest.mark.parametrize(
    ("tags", "xmp", "size", "focal", "center", "distortion", "sigma"),
    [
        ({}, {"drone_dji__DewarpData": DEWARP}, (96, 72), (80.5, 80.25), (48.5, 35.25), OF_DEWARP, 0.01),
        ({}, {"drone_dji__DewarpData": DEWARP, "drone_dji__DewarpFlag": "1"}, (96, 72), (80.5, 80.25), (48.5, 35.25),
         NONE, 0.01),
        ({}, {"drone_dji__DewarpData": "damaged;1,2"} | CALIBRATED, (96, 72), (81.0, 81.0), (48.5, 36.25), NONE, 0.01),
        ({}, CALIBRATED, (96, 72), (81.0, 81.0), (48.5, 36.25), NONE, 0.01),
        ({}, {"drone_dji__CalibratedFocalLength": "81.0"}, (96, 72), (81.0, 81.0), MIDDLE, NONE, 0.01),
        ({}, {f"drone_skydio__CalibratedFocalLength__{axis}": "82" for axis in "XY"}, (96, 72), (82.0, 82.0), MIDDLE,
         NONE, 0.01),
        # Calibrated for another size, or in mm: not believed.
        ({"FocalLengthIn35mmFilm": 24}, {**CALIBRATED, "drone_dji__CalibratedOpticalCenterX": "88"}, (96, 72),
         (66.56, 66.56), MIDDLE, NONE, 0.05),
        ({"FocalLengthIn35mmFilm": 24}, {"drone_dji__CalibratedFocalLength": "8.8"}, (96, 72), (66.56, 66.56), MIDDLE,
         NONE, 0.05),
        # The width of the sensor by the model: 13.2 mm.
        ({"Model": "FC6310", "FocalLength": (88, 10)}, {}, (96, 72), (64.0, 64.0), MIDDLE, NONE, 0.05),
        ({"Model": "FC6310", "FocalLength": (88, 10)}, {}, (72, 96), (64.0, 64.0), (36.0, 48.0), NONE, 0.05),
        ({"Model": "FC6310", "FocalLength": (88, 10), "DigitalZoomRatio": (2, 1)}, {}, (96, 72), (128.0, 128.0), MIDDLE,
         NONE, 0.05),
        # 120 pixels an inch in a photograph that was 96 wide: 20.32 mm.
        ({"FocalLength": (20, 1), "FocalPlaneXResolution": (120, 1), "FocalPlaneResolutionUnit": 2}, {}, (96, 72),
         (94.488189, 94.488189), MIDDLE, NONE, 0.05),
        # Taken 192 wide at 240 an inch, and halved since.
        ({"FocalLength": (20, 1), "FocalPlaneXResolution": (240, 1), "FocalPlaneResolutionUnit": 2,
          "ExifImageWidth": 192, "ExifImageLength": 144}, {}, (96, 72), (94.488189, 94.488189), MIDDLE, NONE, 0.05),
        # 35 mm equivalents, by the diagonal: of 36 x 24 for 3:2, of a whole sensor of 4:3 for 16:9.
        ({"FocalLengthIn35mmFilm": 36}, {}, (96, 64), (96.0, 96.0), (48.0, 32.0), NONE, 0.05),
        ({"FocalLengthIn35mmFilm": 24}, {}, (96, 72), (66.56, 66.56), MIDDLE, NONE, 0.05),
        ({"FocalLengthIn35mmFilm": 24}, {}, (96, 54), (66.56, 66.56), (48.0, 27.0), NONE, 0.05),
        ({"FocalLengthIn35mmFilm": 0}, {}, (96, 72), (115.2, 115.2), MIDDLE, NONE, 0.3),
        ({"FocalLength": (4, 1)}, {}, (96, 72), (115.2, 115.2), MIDDLE, NONE, 0.3),  # of an unknown sensor
        ({}, {}, (72, 96), (115.2, 115.2), (36.0, 48.0), NONE, 0.3),
    ],
)  # fmt: skip
def test_a_lens_is_the_best_that_its_photograph_says(tmp_path, tags, xmp, size, focal, center, distortion, sigma):
    path = write_photograph(tmp_path / "a.jpg", tags, packet(**xmp) if xmp else b"", size)

    found = read_photograph(path).lens

    assert found.focal == pytest.approx(focal, rel=1e-4)
    assert found.principal_point == pytest.approx(center)
    assert found.distortion == distortion
    assert found.sigma == sigma
    assert found.is_guessed == (sigma == 0.3)
    longer = max(size)
    assert found.center_sigma == pytest.approx((0.002 if found.center_source else 0.01) * longer)
    assert found.distortion_sigma == (0.01 if found.distortion_source else 0.05)
