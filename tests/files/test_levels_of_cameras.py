"""cameras.json of photographs of several epochs."""

from dataclasses import replace

import pytest
import torch

from tests.files.two_cameras import two_camera_scene
from torchrefrac.files.cameras import load_cameras, read_cameras, write_cameras
from torchrefrac.scene import Interfaces, SceneError


@pytest.fixture
def written(draw, tmp_path):
    """A scene whose views look in turn through waters of two levels, and its cameras.json."""
    scene, up = two_camera_scene(draw), torch.tensor(((0.0, 0.0, 1.0),)).double()
    ratio, offset = torch.full((2,), 1.33).double(), torch.tensor((0.0, 0.3), dtype=torch.float64)
    views = replace(scene.views, interface=torch.arange(5) % 2)
    scene = replace(scene, interfaces=Interfaces(up.repeat(2, 1), offset, ratio), views=views)
    write_cameras(scene, tmp_path / "cameras.json")
    return scene, tmp_path / "cameras.json"


def test_each_camera_looks_through_the_water_of_its_epoch(written):
    scene, path = written

    again, cameras = read_cameras(path), load_cameras(path)

    assert again.interfaces.offset.tolist() == [0.0, 0.3]
    assert again.views.interface.tolist() == [0, 1, 0, 1, 0]
    torch.testing.assert_close(cameras.interface.plane.offset, scene.interfaces.offset[scene.views.interface])


def test_a_level_that_is_not_there_is_refused(written):
    _, path = written
    path.write_text(path.read_text().replace('"water": 1', '"water": 7', 1))

    with pytest.raises(SceneError, match=r"images\[1\].water is 7, but must lie in 0 to 1, one of water_levels"):
        read_cameras(path)
