"""True surface points on disk: which pixel each belongs to, and what is said of a damaged file."""

import json
import shutil

import numpy as np
import pytest
import torch

from torchrefrac.files.library import embedded_scene
from torchrefrac.files.truth import load_truth, load_truth_points
from torchrefrac.scene import CaptureError

NAMES = load_truth(embedded_scene("tank_small")).names
SHAPE = (len(NAMES), 3, 4)


@pytest.fixture
def arrays():
    """What a file holds: 8 images of 3 x 4 entries, each with coordinates of its own; one is empty."""
    count = int(np.prod(SHAPE))
    points = np.arange(3 * count, dtype=np.float32).reshape(*SHAPE, 3)
    plane = (np.arange(count) % 3).astype(np.int8).reshape(SHAPE)
    points[2, 1, 3], plane[2, 1, 3] = np.nan, -1
    return {"X": points, "plane": plane, "step": np.array(4), "offset": np.array(1.5)}


@pytest.fixture
def write(tmp_path, arrays):
    """Writes the file with `changes` to its arrays (None: left out) beside a truth.json of 8 images."""

    def write(**changes):
        shutil.copy(embedded_scene("tank_small") / "truth.json", tmp_path)
        content = {name: value for name, value in (arrays | changes).items() if value is not None}
        np.savez_compressed(tmp_path / "truth_points.npz", **content)
        return tmp_path

    return write


def test_points_come_back_in_the_order_that_is_asked_for(write, arrays):
    names = (NAMES[5], NAMES[0], NAMES[2])

    found = load_truth_points(write(), names)

    assert found.names == names
    assert found.points.dtype == torch.float64
    assert found.plane.dtype == torch.long
    for row, image in enumerate((5, 0, 2)):
        valid = found.valid[row].numpy()
        np.testing.assert_array_equal(found.points[row].numpy()[valid], arrays["X"][image][valid])
        np.testing.assert_array_equal(found.plane[row].numpy(), arrays["plane"][image])


def test_an_entry_without_a_point_is_marked_and_zero(write):
    found = load_truth_points(write(), NAMES)

    assert (~found.valid).nonzero().tolist() == [[2, 1, 3]]
    assert found.points[2, 1, 3].tolist() == [0.0, 0.0, 0.0]
    assert found.plane[2, 1, 3] == -1
    assert found.points.isfinite().all()


def test_pixels_count_from_the_corner_of_the_first_pixel(write):
    found = load_truth_points(write(), NAMES)

    assert (found.step, found.offset) == (4, 2.0)
    assert found.pixels().shape == (3, 4, 2)
    assert found.pixels()[1, 3].tolist() == [14.0, 6.0]


def test_an_image_that_the_truth_does_not_have_is_left_out(write):
    found = load_truth_points(write(), ("other.png", NAMES[1]))

    assert found.names == (NAMES[1],)
    assert len(found.points) == len(found.valid) == 1


def test_no_file_is_no_truth(tmp_path):
    shutil.copy(embedded_scene("tank_small") / "truth.json", tmp_path)

    assert load_truth_points(tmp_path, NAMES) is None


@pytest.mark.parametrize(
    ("changes", "problem"),
    [
        ({"plane": None, "step": None}, "lacks plane, step"),
        ({"X": np.zeros((*SHAPE, 2))}, r"X is float64 \(8, 3, 4, 2\), but must be floating-point \(m, h, w, 3\)"),
        ({"X": np.zeros((*SHAPE, 3), dtype=np.int32)}, "X is int32"),
        ({"plane": np.zeros((8, 3, 5), dtype=np.int8)}, r"plane is int8 \(8, 3, 5\), but must be .* \(8, 3, 4\)"),
        ({"plane": np.zeros(SHAPE)}, "plane is float64"),
        ({"plane": np.full(SHAPE, 7)}, r"plane has 7, but truth\.json has 3 planes"),
        ({"step": np.array(0)}, "step is 0, but must be a whole number"),
        ({"step": np.array(1.5)}, r"step is 1\.5, but must be a whole number"),
        ({"offset": np.array(np.nan)}, "offset is nan, but must be a finite number"),
        ({"offset": np.array("1.5")}, r"offset is 1\.5, but must be a finite number"),
        (
            {"X": np.zeros((2, 3, 4, 3)), "plane": np.zeros((2, 3, 4), dtype=np.int8)},
            r"X is of 2 images, but truth\.json has 8",
        ),
    ],
)
def test_a_file_that_does_not_fit_is_refused_with_its_array(write, changes, problem):
    with pytest.raises(CaptureError, match=r"truth_points\.npz:? " + problem):
        load_truth_points(write(**changes), NAMES)


@pytest.mark.parametrize("content", [b"", b"no archive", None])
def test_a_damaged_file_is_refused_by_its_name(write, content):
    path = write() / "truth_points.npz"
    path.write_bytes(path.read_bytes()[:-40] if content is None else content)

    with pytest.raises(CaptureError, match=r"truth_points\.npz is not a whole NumPy archive"):
        load_truth_points(path.parent, NAMES)


def test_objects_in_the_file_are_not_run(write):
    folder = write(plane=np.array([{"a": 1}], dtype=object))

    with pytest.raises(CaptureError, match="not a whole NumPy archive"):
        load_truth_points(folder, NAMES)


def test_points_without_truth_json_are_refused(write):
    folder = write()
    (folder / "truth.json").unlink()

    with pytest.raises(CaptureError, match=r"truth\.json does not exist, but names the images of"):
        load_truth_points(folder, NAMES)


def test_the_points_of_the_tank_lie_on_their_planes(shared_data):
    folder = shared_data("tank")
    planes = json.loads((folder / "truth.json").read_text())["planes"]

    found = load_truth_points(folder, load_truth(folder).names)

    normal = torch.tensor([plane["normal"] for plane in planes], dtype=torch.float64)
    constant = torch.tensor([plane["d"] for plane in planes], dtype=torch.float64)
    height = torch.einsum("nk,pk->np", found.points[found.valid], normal) + constant
    off = height.gather(1, found.plane[found.valid][:, None])
    assert off.abs().max() < 1e-4
    assert found.valid.float().mean() > 0.99


def test_each_point_of_the_tank_obeys_snell_along_the_ray_of_its_pixel(shared_data):
    folder = shared_data("tank")
    truth = load_truth(folder)
    lens = json.loads((folder / "capture.json").read_text())["intrinsics"]
    found = load_truth_points(folder, truth.names)

    pixel = found.pixels() - 0.5
    focal, middle = (torch.tensor((lens[a], lens[b]), dtype=torch.float64) for a, b in (("fx", "fy"), ("cx", "cy")))
    plane = (pixel - middle) / focal
    ray = torch.cat((plane, torch.ones_like(plane[..., :1])), dim=-1) @ truth.rotation[3]
    surface = truth.center[3] - ray * (truth.center[3, 2] / ray[..., 2:])
    water = found.points[3] - surface
    sine_air = ray[..., :2].norm(dim=-1) / ray.norm(dim=-1)
    sine_water = water[..., :2].norm(dim=-1) / water.norm(dim=-1)
    off = (sine_air / sine_water - 1.33)[found.valid[3]]
    assert off.abs().max() < 1e-4
