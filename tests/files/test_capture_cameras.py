"""capture.json with several cameras, positions, and gravity of some images only."""

import json
import math

import cv2
import numpy as np
import pytest
import torch

from torchrefrac import load_capture
from torchrefrac.files.masks import Masks
from torchrefrac.scene import CaptureError, Georeference

SIZES = {"a.png": (64, 48), "b.png": (48, 64), "c.png": (64, 48)}
WIDE = [0.1, -0.02, 1e-3, -2e-3, 0.003, 0.05, 0.01, -0.002]


@pytest.fixture
def content():
    """A valid capture.json of two cameras and three images."""
    phone = {"width": 64, "height": 48, "fx": 50.0, "fy": 51.0, "cx": 31.5, "cy": 23.5}
    return {
        "format": "torchrefrac-capture/2",
        "length_unit": "m",
        "pixel_origin": "center",
        "folder": "photos",
        "interface": {"kind": "surface", "layers": [{"index": 1.0}, {"index": 1.333}]},
        "cameras": {
            "phone": phone | {"model": "opencv", "distortion": WIDE, "sigma": {"focal": 0.01, "principal_point": 3.0}},
            "gopro": {"model": "fisheye", "width": 48, "height": 64, "fx": 30.0, "fy": 30.0, "cx": 23.5, "cy": 31.5,
                      "distortion": [0.1, 0.2, 0.0, 0.0], "sigma": {"distortion": 0.02}},
        },
        "down_in_cam_sigma_deg": 0.5,
        "position_sigma": [0.02, 0.02, 0.03],
        "georeference": {"crs": "EPSG:32633", "origin": [5e5, 4e6, 100.0], "vertical": "EPSG:5773"},
        "images": [
            {"name": "a.png", "camera": "phone", "down_in_cam": [0.0, 0.6, 0.8], "height": 31.0, "heading_deg": 90.0},
            {"name": "b.png", "camera": "gopro", "position": [1, 2, 3], "height": 30.0, "height_sigma": 0.1},
            {"name": "c.png", "camera": "phone", "position": [4, 5, 6], "position_sigma": 0.5},
        ],
    }  # fmt: skip


@pytest.fixture
def load(tmp_path, content):
    """Loads the capture with `change` applied to its content."""

    def loaded(change=None, folder="photos"):
        if change is not None:
            change(content)
        for name, (width, height) in SIZES.items():
            (tmp_path / folder).mkdir(exist_ok=True)
            cv2.imwrite(str(tmp_path / folder / name), np.zeros((height, width), dtype=np.uint8))
        (tmp_path / "capture.json").write_text(json.dumps(content))
        return load_capture(tmp_path)

    return loaded


def test_cameras_arrive_by_their_names_with_what_is_uncertain_of_them(load):
    capture = load()
    cameras = capture.cameras

    assert cameras.names == ("phone", "gopro")
    assert capture.camera.tolist() == [0, 1, 0]
    assert cameras.sizes == ((64, 48), (48, 64))
    assert cameras.principal_point.tolist() == [[32.0, 24.0], [24.0, 32.0]]
    assert cameras.distortion.tolist() == [WIDE, [0.1, 0.2] + [0.0] * 6]
    assert cameras.models == ("opencv", "fisheye")
    assert cameras.focal_sigma.tolist() == [0.01, 0.0]
    assert cameras.principal_point_sigma.tolist() == [3.0, 0.0]
    assert cameras.distortion_sigma.tolist() == [0.0, 0.02]
    assert cameras.are_uncertain


def test_what_some_images_alone_state_is_unknown_of_the_others(load):
    capture = load()

    assert capture.has_gravity
    assert capture.down_sigma.tolist() == pytest.approx([math.radians(0.5), math.inf, math.inf])
    assert capture.down_in_cam[1].tolist() == [0.0, 0.0, 1.0]
    assert capture.has_heading.tolist() == [True, False, False]
    assert capture.has_height.tolist() == [True, True, False]
    assert capture.height_sigma.tolist() == pytest.approx([0.31, 0.1, math.inf])
    assert capture.position.tolist() == [[0.0, 0.0, 0.0], [1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]
    assert capture.position_sigma.tolist() == [[math.inf] * 3, [0.02, 0.02, 0.03], [0.5] * 3]


def test_before_a_wall_cameras_may_be_level_and_know_its_normal(load):
    def before_a_wall(content):
        layers = [{"index": 1.0}, {"index": 1.52, "thickness": 0.01}, {"index": 1.333}]
        content["interface"] = {"kind": "wall", "layers": layers}
        content["images"][0]["down_in_cam"] = [0.0, 1.0, 0.0]
        content["images"][1] |= {"normal_in_cam": [0.0, 0.6, -0.8], "normal_sigma_deg": 2.0}

    capture = load(before_a_wall)

    assert capture.down_in_cam[0].tolist() == [0.0, 1.0, 0.0]
    assert capture.normal_in_cam.tolist() == [[0.0, 0.0, -1.0], [0.0, 0.6, -0.8], [0.0, 0.0, -1.0]]
    assert torch.rad2deg(capture.normal_sigma).tolist() == pytest.approx([math.inf, 2.0, math.inf])


def test_the_surface_and_the_frame_arrive(load):
    capture = load()

    assert capture.index_ratio == 1.333
    assert capture.georeference == Georeference("EPSG:32633", (5e5, 4e6, 100.0), "EPSG:5773")
    assert [path.parent.name for path in capture.paths] == ["photos"] * 3


@pytest.mark.parametrize("interface", [{"index_ratio": 1.34}, {"kind": "surface", "index_ratio": 1.34}, None])
def test_a_surface_may_be_stated_by_its_index_ratio(load, interface):
    def state(content):
        del content["interface"]
        content.update({"index_ratio": 1.34} if interface is None else {"interface": interface})

    assert load(state).index_ratio == 1.34


def test_what_is_left_out_is_taken_as_exact_and_usual(load, tmp_path):
    def strip(content):
        del content["folder"], content["georeference"]
        for camera in content["cameras"].values():
            camera.pop("sigma")
        content["cameras"]["phone"].pop("distortion")
        content["cameras"]["phone"].pop("model")

    capture = load(strip, "images")

    assert not capture.cameras.are_uncertain
    assert capture.cameras.distortion[0].tolist() == [0.0] * 8
    assert capture.georeference is None
    assert capture.paths[0] == tmp_path / "images" / "a.png"


def test_one_camera_need_not_be_named_by_the_images(load):
    def single(content):
        content["cameras"].pop("gopro")
        content["images"] = [content["images"][0], content["images"][2]]
        for image in content["images"]:
            image.pop("camera")

    assert load(single).camera.tolist() == [0, 0]


def test_images_may_lie_anywhere(load, tmp_path):
    elsewhere = tmp_path / "elsewhere"
    capture = load(lambda c: c.update(folder=str(elsewhere)), elsewhere)
    assert capture.paths[0] == elsewhere / "a.png"


def test_masks_have_the_sizes_of_their_cameras(load, tmp_path):
    used = np.zeros((64, 48), dtype=np.uint8)
    used[:10] = 255
    (tmp_path / "masks").mkdir()
    cv2.imwrite(str(tmp_path / "masks" / "b.png"), used)

    masks = Masks(load())

    assert masks.used(0) is None
    assert torch.equal(masks.used(1), torch.from_numpy(used > 0))


def test_part_of_a_capture_keeps_what_is_known_of_it(load):
    part = load().of_views([2, 1])

    assert part.camera.tolist() == [0, 1]
    assert part.position[0].tolist() == [4.0, 5.0, 6.0]
    assert part.position_sigma.tolist() == [[0.5] * 3, [0.02, 0.02, 0.03]]
    assert part.height_sigma.tolist() == pytest.approx([math.inf, 0.1])
    assert part.has_heading.tolist() == [False, False]


def _set(**values):
    return lambda content: content.update(values)


def _camera(**values):
    return lambda content: content["cameras"]["phone"].update(values)


def _image(**values):
    return lambda content: content["images"][1].update(values)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (_set(intrinsics={}), "intrinsics is not a known field"),
        (_set(index_ratio=1.333), "index_ratio is given beside interface"),
        (_set(interface={"kind": "wall"}), "interface.layers is missing, but a wall has three or more"),
        (_set(interface={"kind": "lake"}), r"interface.kind is 'lake', but must be 'surface'"),
        (_set(interface={"layers": [{"index": 1.0}]}), "interface.layers lists 1, but there are at least two"),
        (_set(interface={"layers": [{"index": 1.3}, {"index": 1.0}]}), "has an index of 1 beyond one of 1.3"),
        (_set(cameras={}), "cameras is empty, but must describe at least one camera"),
        (lambda c: c.pop("cameras"), "cameras is missing, but must describe at least one camera"),
        (_set(georeference={"origin": [0, 0, 0]}), "georeference.crs is missing"),
        (_set(georeference={"crs": "EPSG:32633", "origin": [0, 0, 0], "slope": [0, 0]}), "slope is not a known field"),
        (_set(length_unit="cm"), "length_unit is 'cm', but must be 'm' where there is a georeference"),
        (_set(folder=7), "folder is 7, but must be a non-empty string"),
        (_image(normal_in_cam=[0.0, 0.0, 1.0], normal_sigma_deg=1.0), "must point towards the camera"),
        (_image(normal_in_cam=[0.0, 0.6, -0.8]), "normal_sigma_deg is missing"),
        (_image(down_in_cam=[0.0, 1.0, 0.0]), "a camera that looks at the sky"),
        (lambda c: c.pop("position_sigma"), "position_sigma is missing"),
        (_set(position_sigma=[1, 1]), "position_sigma is a list of 2, but must be a list of 3 numbers"),
        (_set(position_sigma=[1, 0, 1]), r"position_sigma\[1\] is 0, but must be above 0"),
        (_camera(model="thin prism"), "cameras.phone.model is 'thin prism', but must be 'opencv' or 'fisheye'"),
        (_camera(distortion=[1, 2, 3]), "distortion is a list of 3, but must be a list of 0 or 4 or 5 or 8 numbers"),
        (_camera(model="fisheye"), "distortion is a list of 8, but must be a list of 4 numbers"),
        (_camera(width=65), r"a.png is 64x48, but cameras.phone.width and height say 65x48"),
        (_camera(sigma={"focal": 0}), r"cameras.phone.sigma.focal is 0, but must be above 0 and at most 1"),
        (_camera(sigma={"skew": 1}), r"cameras.phone.sigma.skew is not a known field"),
        (_image(camera="nikon"), r"images\[1\].camera is 'nikon', but cameras has phone, gopro"),
        (lambda c: c["images"][1].pop("camera"), r"images\[1\].camera is missing, but there are several cameras"),
        (_image(height_sigma=0), r"images\[1\].height_sigma is 0, but must be above 0"),
        (_image(center_prior=[0, 0, 0]), r"images\[1\].center_prior is not a known field"),
        (_image(down_in_cam=[0, 0, -1]), "a camera that looks at the sky"),
    ],
)
def test_what_cannot_be_right_is_refused_by_name(load, change, sentence):
    with pytest.raises(CaptureError, match=sentence):
        load(change)


def test_epochs_arrive_in_the_order_of_the_images(load):
    def of(*names):
        def change(content):
            for image, name in zip(content["images"], names, strict=False):
                image["epoch"] = name

        return change

    capture = load(of("june", "may", "june"))
    assert (capture.epochs, capture.epoch.tolist()) == (("june", "may"), [0, 1, 0])
    assert capture.of_views([1, 2]).epoch.tolist() == [1, 0]
    alone = load(of("may", "may", "may"))
    assert (alone.epochs, alone.epoch.tolist()) == ((), [0, 0, 0])
    with pytest.raises(CaptureError, match=r"images\[2\].epoch of c.png is missing, but others have it"):
        load(lambda content: content["images"][2].pop("epoch"))
