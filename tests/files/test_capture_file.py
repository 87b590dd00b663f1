"""capture.json: what is read, and what is refused with which sentence."""

import math

import cv2
import numpy as np
import pytest
import torch

from torchrefrac import load_capture
from torchrefrac.files.library import embedded_scene
from torchrefrac.scene import CaptureError


def test_opencv_pixels_are_shifted_by_half_a_pixel_once(write_capture):
    capture = load_capture(write_capture())
    assert capture.cameras[0].principal_point.tolist() == [32.0, 24.0]


def test_colmap_pixels_are_taken_as_they_are(write_capture):
    capture = load_capture(write_capture(lambda c: c.update(pixel_origin="corner")))
    assert capture.cameras[0].principal_point.tolist() == [31.5, 23.5]


def test_all_fields_arrive(write_capture):
    capture = load_capture(write_capture())
    assert capture.names == ("a.png", "b.png")
    assert capture.index_ratio == 1.333
    assert capture.length_unit == "cm"
    assert capture.has_gravity
    assert capture.down_sigma.tolist() == pytest.approx([math.radians(0.5)] * len(capture))
    assert capture.has_height.tolist() == [True, False]
    assert capture.height[0] == 30.0
    assert capture.cameras[0].focal.tolist() == [50.0, 51.0]
    assert capture.cameras[0].distortion.tolist() == [0.1, 0, 0, 0, 0]
    assert torch.equal(capture.down_in_cam.norm(dim=-1), torch.ones(2, dtype=torch.float64))


def test_a_lens_without_distortion_may_leave_it_out(write_capture):
    capture = load_capture(write_capture(lambda c: c["intrinsics"].pop("distortion")))
    assert capture.cameras[0].distortion.tolist() == [0.0] * 5


def test_gravity_may_be_left_out_of_all_images(write_capture):
    def strip(content):
        del content["down_in_cam_sigma_deg"]
        for image in content["images"]:
            del image["down_in_cam"]

    capture = load_capture(write_capture(strip))
    assert not capture.has_gravity
    assert capture.down_in_cam.tolist() == [[0.0, 0.0, 1.0]] * 2
    assert capture.down_sigma.isinf().all()


def test_the_embedded_scene_is_complete():
    assert len(load_capture(embedded_scene("tank_small"))) == 8


def _set(**values):
    return lambda content: content.update(values)


def _intrinsic(**values):
    return lambda content: content["intrinsics"].update(values)


def _image(**values):
    return lambda content: content["images"][1].update(values)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (_set(format="something/2"), "format is 'something/2', but must be 'torchrefrac-capture/1'"),
        (_set(index_ratio=0.9), "index_ratio is 0.9, but n_water / n_air lies between 1 and 3"),
        (_set(index_ratio=13.33), "index_ratio is 13.33"),
        (_set(index_ratio="1.33"), "index_ratio is '1.33', but must be a number"),
        (_set(index_ratio=True), "index_ratio is true, but must be a number"),
        (_set(index_ratio=float("nan")), "index_ratio is nan, but must be finite"),
        (lambda c: c.pop("index_ratio"), "index_ratio is missing"),
        (_set(pixel_origin="middle"), "pixel_origin is 'middle', but must be 'center'"),
        (_set(length_unit=7), "length_unit is 7, but must be a non-empty string"),
        (_set(down_in_cam_sigma_deg=0), "down_in_cam_sigma_deg is 0"),
        (_set(images=[]), "images lists 0, but a reconstruction needs at least 2"),
        (lambda c: c["images"].pop(), "images lists 1, but a reconstruction needs at least 2"),
        (_set(images={"a": 1}), "images is an object, but must be a list of objects"),
        (_set(images=["a.png", "b.png"]), r"images\[0\] is 'a.png', but must be an object"),
        (_set(index_ration=1.3), "index_ration is not a known field"),
        (_intrinsic(fx=-1), "intrinsics.fx is -1, but must be above 0"),
        (_intrinsic(fx=None), "intrinsics.fx is null, but must be a number"),
        (_intrinsic(width=64.5), "intrinsics.width is 64.5, but must be a whole number"),
        (_intrinsic(distortion=[1, 2]), "intrinsics.distortion is a list of 2, but must be a list of 5 numbers"),
        (lambda c: c["intrinsics"].pop("cy"), "intrinsics.cy is missing"),
        (_intrinsic(width=65), "a.png is 64x48, but intrinsics.width and height say 65x48"),
        (_image(name="a.png"), r"images\[1\].name is 'a.png', which an image before it already has"),
        (_image(name="../b.png"), "must name a file inside images/"),
        (_image(name="c.png"), "c.png does not exist, but capture.json lists it"),
        (_image(down_in_cam=[0, 0, 1.01]), r"images\[1\].down_in_cam has length 1.0100, but must be a unit vector"),
        (_image(down_in_cam=[0, 0, -1]), "a camera that looks at the sky"),
        (_image(down_in_cam=[0, 1]), r"images\[1\].down_in_cam is a list of 2, but must be a list of 3 numbers"),
        (_image(down_in_cam=[0, 0, "1"]), r"images\[1\].down_in_cam\[2\] is '1', but must be a number"),
        (
            lambda c: c["images"][1].pop("down_in_cam"),
            r"down_in_cam of b.png is missing, but others have it",
        ),
        (lambda c: c.pop("down_in_cam_sigma_deg"), "down_in_cam_sigma_deg is missing"),
        (_image(height=0), r"images\[1\].height is 0, but a camera stands above the water"),
        (_image(hieght=3), r"images\[1\].hieght is not a known field"),
    ],
)
def test_a_capture_that_cannot_be_right_is_refused_by_name(write_capture, change, sentence):
    folder = write_capture(change)
    with pytest.raises(CaptureError, match=sentence):
        load_capture(folder)


def test_gravity_is_normalised_within_the_tolerance(write_capture):
    capture = load_capture(write_capture(_image(down_in_cam=[0, 0, 1.0005])))
    assert capture.down_in_cam[1].tolist() == [0, 0, 1]


def test_malformed_json_says_where(write_capture):
    folder = write_capture()
    (folder / "capture.json").write_text('{"format": ')
    with pytest.raises(CaptureError, match=r"capture.json is not valid JSON: .* line 1"):
        load_capture(folder)


def test_json_that_is_no_object_is_refused(write_capture):
    folder = write_capture()
    (folder / "capture.json").write_text("[1, 2]")
    with pytest.raises(CaptureError, match="the top level is a list of 2, but must be an object"):
        load_capture(folder)


@pytest.mark.parametrize("focal", [1e-308, 1e308])
def test_a_focal_length_of_no_lens_is_refused(write_capture, focal):
    folder = write_capture(lambda c: c["intrinsics"].update(fy=focal))
    with pytest.raises(
        CaptureError, match=r"intrinsics.fy is .* but with images 64 pixels long must lie between 3.2 and 64000"
    ):
        load_capture(folder)


def test_a_truncated_image_is_refused(write_capture):
    folder = write_capture()
    (folder / "images" / "b.png").write_bytes(b"not an image")
    with pytest.raises(CaptureError, match=r"b.png cannot be read as an image"):
        load_capture(folder)


def test_a_missing_capture_file_is_named(tmp_path):
    with pytest.raises(CaptureError, match=r"capture.json does not exist"):
        load_capture(tmp_path)


def test_a_missing_folder_is_named(tmp_path):
    with pytest.raises(CaptureError, match="nowhere is not a folder"):
        load_capture(tmp_path / "nowhere")


def test_an_unknown_embedded_scene_lists_the_known_ones():
    with pytest.raises(CaptureError, match=r"'pool' does not come with the package; known are tank_small"):
        embedded_scene("pool")


def test_exif_orientation_does_not_turn_the_image(write_capture):
    folder = write_capture(lambda c: c["images"][1].update(name="b.jpg"))
    _, jpeg = cv2.imencode(".jpg", np.zeros((48, 64), dtype=np.uint8))
    orientation_6 = bytes.fromhex("ffe1 0022 457869660000 4d4d002a00000008 0001 0112 0003 00000001 0006 0000 00000000")
    (folder / "images" / "b.jpg").write_bytes(jpeg.tobytes()[:2] + orientation_6 + jpeg.tobytes()[2:])
    assert len(load_capture(folder)) == 2


SQUARE = [[0, 0], [30, 0.5], [30, 20], [0, 20]]


def test_the_extent_of_the_water_is_read_from_above_and_from_photographs(write_capture):
    def state(content):
        content["water_extent"] = SQUARE
        content["images"][1]["water_extent"] = SQUARE

    capture = load_capture(write_capture(state))

    extent = capture.water_extent
    assert extent is not None
    corners = torch.tensor(SQUARE, dtype=torch.float64)
    assert torch.equal(extent.from_above, corners)
    assert extent.in_images[0] is None
    assert torch.equal(extent.in_images[1], corners + 0.5)  # pixel_origin is "center"
    assert extent.is_drawn
    turned = capture.of_views([1, 0]).water_extent
    assert turned is not None
    assert turned.in_images[1] is None


def test_a_capture_says_nothing_of_where_the_water_ends_unless_it_is_stated(write_capture):
    assert load_capture(write_capture()).water_extent is None


@pytest.mark.parametrize(
    ("extent", "problem"),
    [
        (SQUARE[:2], "water_extent has 2 corners, but a polygon has from 3 to 10000"),
        ([SQUARE[0], SQUARE[2], SQUARE[1], SQUARE[3]], "water_extent is a polygon whose sides cross or fold back"),
        ([*SQUARE, SQUARE[0]], "water_extent is a polygon whose sides cross or fold back"),
        ([[0, 0], [1, 0], [1]], r"water_extent\[2\] is a list of 1, but must be a list of 2 numbers"),
        ([[0, 0], [1, 0], [1, 1e999]], r"water_extent\[2\]\[1\] is inf, but must be finite"),
        ("everywhere", "water_extent is 'everywhere', but must be a list of lists of 2 numbers"),
    ],
)
@pytest.mark.parametrize("of_image", [False, True], ids=["from above", "in an image"])
def test_an_extent_that_is_no_polygon_is_refused(write_capture, extent, problem, of_image):
    change = _image(water_extent=extent) if of_image else _set(water_extent=extent)
    with pytest.raises(CaptureError, match=problem) as error:
        load_capture(write_capture(change))
    assert "\n" not in str(error.value)
    assert ("images[1].water_extent" in str(error.value)) == of_image
