"""COLMAP models, text and binary: against a model written by hand, against pycolmap, and against damage."""

import struct
from dataclasses import replace

import pytest
import torch

from tests.files.two_cameras import BENT, PLAIN, assert_same, assert_same_intrinsics, two_camera_scene
from torchrefrac.camera import Intrinsics
from torchrefrac.files.colmap.model import read_colmap, write_colmap
from torchrefrac.scene import Cameras, SceneError

CAMERAS = """# a comment
12 RADIAL 640 480 500 320 240 0.1 -0.02

7 PINHOLE 800 600 700 710 400 300
99 OPENCV 10 10 5 5 5 5 0 0 0 0
"""
# The second image (id 2) is turned by a quarter about z, the first (id 30) by none. Point 1 of image 2 is nobody's.
IMAGES = """# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME
30 2 0 0 0 -1 -2 -3 7 second image.jpg
10.5 20.5 500 30.5 40.5 6
2 0.5 0 0 0.5 1 2 3 12 a/first.jpg
1.25 2.5 6 7 7 -1 3.5 4.5 500
"""
POINTS = """500 1 2 3 10 20 30 0.5 2 2 30 0
6 -1 -2 -3.5 40 50 60 -1 30 1 2 0
"""


@pytest.fixture
def write_by_hand(tmp_path):
    """Writes the model above, with texts of some files replaced, into a folder."""

    def write(cameras=CAMERAS, images=IMAGES, points=POINTS, folder="."):
        place = tmp_path / folder
        place.mkdir(parents=True, exist_ok=True)
        for name, content in (("cameras", cameras), ("images", images), ("points3D", points)):
            (place / f"{name}.txt").write_text(content)
        return tmp_path

    return write


@pytest.fixture
def scene(draw):
    return two_camera_scene(draw)


def named(scene, *names):
    return replace(scene, views=replace(scene.views, names=names))


def test_a_model_written_by_hand_means_what_the_format_says(write_by_hand):
    scene = read_colmap(write_by_hand())

    assert scene.views.names == ("a/first.jpg", "second image.jpg")
    assert scene.length_unit == "unit"
    assert len(scene.cameras) == 2
    assert_same_intrinsics(scene.cameras[0], Intrinsics.create(800, 600, (700.0, 710.0), (400.0, 300.0)))
    assert_same_intrinsics(scene.cameras[1], Intrinsics.create(640, 480, 500.0, (320.0, 240.0), (0.1, -0.02, 0, 0, 0)))
    assert scene.views.camera.tolist() == [1, 0]
    quarter = torch.tensor([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
    torch.testing.assert_close(scene.views.rotation[0], quarter)
    assert torch.equal(scene.views.rotation[1], torch.eye(3, dtype=torch.float64))
    torch.testing.assert_close(scene.views.center, torch.tensor([[-2.0, 1, -3], [1, 2, 3]], dtype=torch.float64))
    assert scene.points.tolist() == [[-1.0, -2.0, -3.5], [1.0, 2.0, 3.0]]
    assert scene.colors.tolist() == [[40, 50, 60], [10, 20, 30]]
    assert scene.observations.view.tolist() == [1, 0, 0, 1]
    assert scene.observations.point.tolist() == [0, 0, 1, 1]
    assert scene.observations.pixels.tolist() == [[30.5, 40.5], [1.25, 2.5], [3.5, 4.5], [10.5, 20.5]]


def test_text_as_windows_editors_save_it_is_read(write_by_hand):
    texts = ("\ufeff" + text.replace("\n", "\r\n") for text in (CAMERAS, IMAGES, POINTS))

    assert_same(read_colmap(write_by_hand(*texts, folder="other") / "other"), read_colmap(write_by_hand()))


@pytest.mark.parametrize(
    ("line", "focal", "principal", "distortion"),
    [
        ("SIMPLE_PINHOLE 640 480 500 320 240", (500, 500), (320, 240), (0, 0, 0, 0, 0)),
        ("PINHOLE 640 480 500 510 320 240", (500, 510), (320, 240), (0, 0, 0, 0, 0)),
        ("SIMPLE_RADIAL 640 480 500 320 240 0.1", (500, 500), (320, 240), (0.1, 0, 0, 0, 0)),
        ("RADIAL 640 480 500 320 240 0.1 0.2", (500, 500), (320, 240), (0.1, 0.2, 0, 0, 0)),
        ("OPENCV 640 480 500 510 320 240 0.1 0.2 0.3 0.4", (500, 510), (320, 240), (0.1, 0.2, 0.3, 0.4, 0)),
        (
            "FULL_OPENCV 640 480 500 510 320 240 0.1 0.2 0.3 0.4 0.5 0 0 0",
            (500, 510),
            (320, 240),
            (0.1, 0.2, 0.3, 0.4, 0.5),
        ),
        (
            "FULL_OPENCV 640 480 500 510 320 240 0.1 0.2 0.3 0.4 0.5 0.6 0.7 0.8",
            (500, 510),
            (320, 240),
            (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8),
        ),
    ],
)
def test_each_camera_model_becomes_its_intrinsics(write_by_hand, line, focal, principal, distortion):
    images = IMAGES.replace(" 12 ", " 7 ")

    scene = read_colmap(write_by_hand(cameras=f"7 {line}\n", images=images))

    assert len(scene.cameras) == 1
    assert_same_intrinsics(scene.cameras[0], Intrinsics.create(640, 480, focal, principal, distortion))


@pytest.mark.parametrize(
    ("distortion", "model"),
    [
        ((0.0,) * 5, "PINHOLE 640 480 500.0 501.0 321.5 239.25"),
        ((0.0, 0.0, 0.25, 0.0, 0.0), "OPENCV 640 480 500.0 501.0 321.5 239.25 0.0 0.0 0.25 0.0"),
        ((0.1, 0, 0, 0, 0.5), "FULL_OPENCV 640 480 500.0 501.0 321.5 239.25 0.1 0.0 0.0 0.0 0.5 0.0 0.0 0.0"),
    ],
)
def test_intrinsics_are_written_as_the_smallest_model_that_holds_it(tmp_path, scene, distortion, model):
    intrinsics = replace(PLAIN, distortion=torch.tensor(distortion, dtype=torch.float64))

    write_colmap(replace(scene, cameras=Cameras.of((intrinsics, BENT))), tmp_path)

    assert (tmp_path / "cameras.txt").read_text().splitlines()[1] == f"1 {model}"


@pytest.mark.parametrize("binary", [True, False], ids=["binary", "text"])
@pytest.mark.parametrize(
    "line",
    [
        "SIMPLE_PINHOLE 640 480 500.0 320.0 240.0",
        "SIMPLE_RADIAL 640 480 500.0 320.0 240.0 0.125",
        "RADIAL 640 480 500.0 320.0 240.0 0.125 0.25",
        "FULL_OPENCV 640 480 500.0 510.0 320.0 240.0 0.0 0.0 0.0 0.0 0.0 0.0 0.0 0.0",
        "FULL_OPENCV 640 480 500.0 510.0 320.0 240.0 0.1 0.2 0.3 0.4 0.5 0.6 0.7 0.8",
        "OPENCV_FISHEYE 640 480 500.0 510.0 320.0 240.0 0.1 0.2 0.3 0.4",
    ],
)
def test_a_camera_is_written_as_the_model_that_it_was_read_as(tmp_path, write_by_hand, line, binary):
    given = read_colmap(write_by_hand(cameras=f"7 {line}\n", images=IMAGES.replace(" 12 ", " 7 ")))

    write_colmap(named(given, "a", "b"), tmp_path / "first", binary=binary)
    again = read_colmap(tmp_path / "first")
    write_colmap(again, tmp_path / "second")

    assert (tmp_path / "second" / "cameras.txt").read_text().splitlines()[1] == f"1 {line}"
    assert again.cameras.models == (("fisheye",) if "FISHEYE" in line else ("opencv",))


def test_a_camera_that_its_model_no_longer_holds_becomes_another(tmp_path, write_by_hand):
    radial = "7 SIMPLE_RADIAL 640 480 500 320 240 0.1\n"
    given = named(read_colmap(write_by_hand(cameras=radial, images=IMAGES.replace(" 12 ", " 7 "))), "a", "b")
    bent = given.cameras.distortion + torch.tensor([0.0, 0.25, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0], dtype=torch.float64)

    write_colmap(replace(given, cameras=replace(given.cameras, distortion=bent)), tmp_path / "out")

    written = (tmp_path / "out" / "cameras.txt").read_text().splitlines()[1]
    assert written == "1 OPENCV 640 480 500.0 500.0 320.0 240.0 0.1 0.25 0.0 0.0"


@pytest.mark.parametrize("binary", [True, False], ids=["binary", "text"])
def test_a_scene_survives_the_files(tmp_path, scene, binary):
    write_colmap(scene, tmp_path, binary=binary)

    assert_same(read_colmap(tmp_path), scene, poses_exact=False)


def test_text_and_binary_files_read_the_same_to_the_last_bit(tmp_path, scene):
    write_colmap(scene, tmp_path / "text")
    write_colmap(scene, tmp_path / "binary", binary=True)

    assert_same(read_colmap(tmp_path / "text"), read_colmap(tmp_path / "binary"))


@pytest.mark.parametrize("binary", [True, False], ids=["binary", "text"])
def test_images_without_points_survive_the_files(tmp_path, scene, binary):
    bare = scene.with_points(scene.points[:0], scene.colors[:0])

    write_colmap(bare, tmp_path, binary=binary)

    assert_same(read_colmap(tmp_path), bare, poses_exact=False)


def test_no_image_at_all_is_a_scene_too(write_by_hand):
    assert len(read_colmap(write_by_hand("", "", "")).views) == 0


def test_a_name_beyond_ascii_survives_both_kinds_of_file(tmp_path, scene):
    scene = named(scene, "Küste.jpg", "海/1.jpg", "c", "d", "e")

    for binary in (True, False):
        write_colmap(scene, tmp_path / str(binary), binary=binary)
        assert read_colmap(tmp_path / str(binary)).views.names == scene.views.names


def test_observations_of_a_point_twice_in_an_image_and_lone_points_are_dropped(write_by_hand):
    images = IMAGES.replace("30.5 40.5 6", "30.5 40.5 500")
    points = "500 1 2 3 10 20 30 0.5 30 1 2 2 30 0\n6 -1 -2 -3.5 40 50 60 -1 2 0\n"

    scene = read_colmap(write_by_hand(images=images, points=points))

    assert scene.points.tolist() == [[1, 2, 3]]
    assert (scene.observations.view.tolist(), scene.observations.point.tolist()) == ([1, 0], [0, 0])
    assert scene.observations.pixels.tolist() == [[30.5, 40.5], [3.5, 4.5]]


@pytest.mark.parametrize("folder", [".", "sparse", "sparse/0"])
def test_the_model_is_found_where_colmap_leaves_it(write_by_hand, folder):
    assert len(read_colmap(write_by_hand(folder=folder)).views) == 2


def test_binary_files_go_before_text_files(tmp_path, write_by_hand, scene):
    write_colmap(scene, tmp_path, binary=True)

    assert len(read_colmap(write_by_hand()).views) == 5


def test_errors_of_points_stand_in_their_column(tmp_path, scene):
    write_colmap(scene, tmp_path / "unknown")
    write_colmap(scene, tmp_path / "known", errors=torch.arange(40.0) / 4)

    def column(folder):
        lines = (tmp_path / folder / "points3D.txt").read_text().splitlines()
        return [float(line.split()[7]) for line in lines if not line.startswith("#")]

    assert column("unknown") == [-1.0] * 40
    assert column("known") == [i / 4 for i in range(40)]
    with pytest.raises(SceneError, match=r"errors has shape \(3,\), but must have \(40,\)"):
        write_colmap(scene, tmp_path, errors=torch.zeros(3))


def test_a_model_replaces_one_of_its_kind_but_is_not_mixed_with_others(tmp_path, scene):
    write_colmap(scene, tmp_path)
    write_colmap(scene.of_views(torch.arange(5) > 0).cleaned(), tmp_path)
    assert len(read_colmap(tmp_path).views) == 4

    with pytest.raises(SceneError, match=r"holds cameras.txt, images.txt, points3D.txt of another model"):
        write_colmap(scene, tmp_path, binary=True)
    (tmp_path / "rigs.bin").touch()
    with pytest.raises(SceneError, match=r"holds rigs.bin of another model"):
        write_colmap(scene, tmp_path)


def test_a_write_that_fails_leaves_the_earlier_model(tmp_path, scene):
    write_colmap(scene, tmp_path)
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}

    with pytest.raises(SceneError, match=r"'b c.jpg' has a blank, at which COLMAP would cut"):
        write_colmap(named(scene, "a", "b c.jpg", "d", "e", "f"), tmp_path)

    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


@pytest.mark.parametrize("name", ["", "a\0b"])
def test_a_name_that_no_file_can_hold_is_refused(tmp_path, scene, name):
    with pytest.raises(SceneError, match="which a COLMAP model cannot hold"):
        write_colmap(named(scene, name, *scene.views.names[1:]), tmp_path, binary=True)


@pytest.mark.parametrize(
    ("file", "old", "new", "message"),
    [
        (
            "cameras",
            "PINHOLE",
            "FOV",
            r"cameras.txt: camera 7 has the model FOV, but understood are SIMPLE_PINHOLE, PINH",
        ),
        ("cameras", "400 300", "400", r"cameras.txt, line 4: has 7 columns, but must have CAMERA_ID PINHOLE WIDTH"),
        ("cameras", "700 710", "700 x", r"cameras.txt, line 4: could not convert string to float: 'x'"),
        ("cameras", "700 710", "700 nan", r"cameras.txt: camera 7 has a parameter that is not finite"),
        ("cameras", "700 710", "700 0", r"cameras.txt: camera 7 has a focal length of 0"),
        ("cameras", "800 600", "800 0", r"cameras.txt: camera 7 is 800x0 pixels"),
        ("cameras", "99 OPENCV", "7 OPENCV", r"cameras.txt gives a camera id twice"),
        ("images", "-3 7 second", "-3 8 second", r"images.txt: second image.jpg has camera 8, which cameras.txt lacks"),
        (
            "images",
            "-1 -2 -3 7 second image.jpg",
            "-1 -2 -3",
            r"images.txt, line 2: has 8 columns, but must have IMAGE_ID",
        ),
        ("images", "40.5 6", "40.5", r"images.txt, line 3: has 5 columns, but must have X Y POINT3D_ID"),
        ("images", "40.5 6", "40.5 6.5", r"images.txt, line 3: invalid literal for int"),
        ("images", "40.5 6", f"40.5 {2**70}", r"images.txt, line 3: "),
        ("images", "40.5 6", "inf 6", r"images.txt: second image.jpg \(feature 1\) has the pixel \[30.5, inf\]"),
        ("images", "30 2 0 0 0", "30 0 0 0 0", r"images.txt: image 30 \(second image.jpg\) has a quaternion of length"),
        ("images", "30 2 0 0 0", "30 nan 0 0 0", r"image 30 \(second image.jpg\) has the quaternion \[nan, 0.0"),
        ("images", "-1 -2 -3", "-1 -inf -3", r"image 30 \(second image.jpg\) has the translation \[-1.0, -inf"),
        ("images", "30 2 0", "2 2 0", r"images.txt gives image 2 twice"),
        ("images", "a/first.jpg", "second image.jpg", r"images.txt has two images with the name second image.jpg"),
        ("images", "7 7 -1", "7 7 6", r"images.txt: a/first.jpg shows point 6, but points3D.txt .* does not list"),
        ("images", "7 7 -1", "7 7 8", r"images.txt: a/first.jpg shows point 8, but points3D.txt has no such point"),
        ("points3D", "30 0.5", "256 0.5", r"points3D.txt, line 1: colour \[10, 20, 256\] must lie in 0 to 255"),
        (
            "points3D",
            "-1 30 1 2 0",
            "-1 30 1 2",
            r"points3D.txt, line 2: has 11 columns, but must have POINT3D_ID X Y Z",
        ),
        ("points3D", "-3.5", "nan", r"points3D.txt: point 6 has the position \[-1.0, -2.0, nan\]"),
        ("points3D", "2 2 30 0", "2 2 31 0", r"the track of point 500 has image 31, which images.txt lacks"),
        ("points3D", "2 2 30 0", "2 2 30 9", r"point 500 has feature 9 of second image.jpg, which has 2 of them"),
        ("points3D", "2 2 30 0", "2 2 30 1", r"feature 1 of second image.jpg, for which images.txt has point 6"),
        ("points3D", "6 -1 -2", "500 -1 -2", r"for which images.txt has point 6"),
    ],
)
def test_a_damaged_text_file_is_refused_by_line_or_record(write_by_hand, file, old, new, message):
    files = {"cameras": CAMERAS, "images": IMAGES, "points": POINTS}
    key = "points" if file == "points3D" else file
    assert old in files[key]
    files[key] = files[key].replace(old, new, 1)

    with pytest.raises(SceneError, match=message):
        read_colmap(write_by_hand(**files))


def test_a_point_given_twice_is_refused(write_by_hand):
    with pytest.raises(SceneError, match=r"points3D.txt gives point 500 twice"):
        read_colmap(write_by_hand(points=POINTS + "500 1 2 3 10 20 30 0.5 2 2 30 0\n"))


@pytest.mark.parametrize("name", ["cameras", "images", "points3D"])
def test_binary_files_are_refused_wherever_they_are_cut(tmp_path, draw, name):
    write_colmap(two_camera_scene(draw, views=3, points=4), tmp_path, binary=True)
    path = tmp_path / f"{name}.bin"
    whole = path.read_bytes()

    for size in range(len(whole)):
        path.write_bytes(whole[:size])
        with pytest.raises(SceneError, match=rf"{name}.bin is truncated"):
            read_colmap(tmp_path)
    path.write_bytes(whole + b"xy")
    with pytest.raises(SceneError, match=rf"{name}.bin has 2 bytes after the last of its"):
        read_colmap(tmp_path)


@pytest.mark.parametrize("name", ["cameras", "images", "points3D"])
def test_a_count_beyond_the_file_is_refused(tmp_path, scene, name):
    write_colmap(scene, tmp_path, binary=True)
    path = tmp_path / f"{name}.bin"
    path.write_bytes(struct.pack("<Q", 2**64 - 1) + path.read_bytes()[8:])

    with pytest.raises(SceneError, match=rf"{name}.bin is truncated: it ends within record \d+ of {2**64 - 1}"):
        read_colmap(tmp_path)


@pytest.mark.parametrize(("number", "name"), [(7, "FOV"), (77, "number 77")])
def test_a_camera_model_that_no_lens_holds_is_named_in_binary_files_too(tmp_path, scene, number, name):
    write_colmap(scene, tmp_path, binary=True)
    path = tmp_path / "cameras.bin"
    content = bytearray(path.read_bytes())
    content[12:16] = struct.pack("<i", number)
    path.write_bytes(content)

    with pytest.raises(SceneError, match=f"cameras.bin: camera 1 has the model {name}, but understood are"):
        read_colmap(tmp_path)


def test_files_that_are_not_text_are_refused(tmp_path, write_by_hand):
    write_by_hand()
    (tmp_path / "images.txt").write_bytes(b"\xff\xfe1 2 3")
    with pytest.raises(SceneError, match=r"images.txt is not UTF-8 text"):
        read_colmap(tmp_path)


def test_what_is_missing_is_said(tmp_path, write_by_hand):
    with pytest.raises(SceneError, match="nowhere is not a folder"):
        read_colmap(tmp_path / "nowhere")
    with pytest.raises(SceneError, match=r"holds no COLMAP model: looked for cameras, images and points3D"):
        read_colmap(tmp_path)
    write_by_hand(folder="sparse/0")
    (tmp_path / "sparse" / "0" / "points3D.txt").unlink()
    with pytest.raises(SceneError, match=r"sparse/0 lacks points3D.txt"):
        read_colmap(tmp_path)


@pytest.fixture
def pycolmap():
    return pytest.importorskip("pycolmap")


@pytest.mark.parametrize("binary", [True, False], ids=["binary", "text"])
def test_pycolmap_reads_what_is_written(pycolmap, tmp_path, scene, binary):
    write_colmap(scene, tmp_path, binary=binary, errors=torch.arange(40.0))

    model = pycolmap.Reconstruction(str(tmp_path))

    assert (model.num_reg_images(), model.num_points3D()) == (5, 40)
    for i, name in enumerate(scene.views.names):
        image = model.find_image_with_name(name)
        pose = torch.from_numpy(image.cam_from_world().matrix())
        torch.testing.assert_close(pose[:, :3], scene.views.rotation[i], rtol=0.0, atol=4e-15)
        center = torch.from_numpy(image.projection_center())
        torch.testing.assert_close(center, scene.views.center[i], rtol=0.0, atol=1e-13)
    for k in range(40):
        point = model.points3D[k + 1]
        rows = (scene.observations.point == k).nonzero()[:, 0].tolist()
        assert point.xyz.tolist() == scene.points[k].tolist()
        assert point.color.tolist() == scene.colors[k].tolist()
        assert point.error == k
        elements = [(model.images[e.image_id], e.point2D_idx) for e in point.track.elements]
        assert [image.name for image, _ in elements] == [
            scene.views.names[scene.observations.view[row]] for row in rows
        ]
        features = [image.points2D[index] for image, index in elements]
        assert [feature.xy.tolist() for feature in features] == scene.observations.pixels[rows].tolist()
        assert {feature.point3D_id for feature in features} == {k + 1}


@pytest.mark.parametrize("binary", [True, False], ids=["binary", "text"])
def test_what_pycolmap_writes_is_read(pycolmap, tmp_path, scene, binary):
    write_colmap(scene, tmp_path / "ours", binary=True)
    (tmp_path / "theirs").mkdir()
    model = pycolmap.Reconstruction(str(tmp_path / "ours"))

    (model.write_binary if binary else model.write_text)(str(tmp_path / "theirs"))

    assert_same(read_colmap(tmp_path / "theirs"), scene, poses_exact=False)


def test_pycolmap_projects_through_the_same_lens(pycolmap, tmp_path, draw, scene):
    write_colmap(scene, tmp_path)
    cameras = pycolmap.Reconstruction(str(tmp_path)).cameras
    rays = torch.cat((draw.uniform(-0.4, 0.4, 50, 2), torch.ones(50, 1, dtype=torch.float64)), dim=-1)

    for i in range(len(scene.cameras)):
        projected = torch.from_numpy(cameras[i + 1].img_from_cam(rays.numpy()))
        torch.testing.assert_close(scene.cameras[i].pixels_from_plane(rays[:, :2]), projected, rtol=0.0, atol=1e-10)
