"""`torchrefrac densify frames=...`: cameras that stand still, and other moments that they have photographed."""

import csv
import shutil
from dataclasses import replace

import pytest
import torch

from tests.files.two_cameras import two_camera_scene
from torchrefrac.commands.frames import of_frame
from torchrefrac.files.library import embedded_scene
from torchrefrac.scene import Capture

IMAGES = embedded_scene("tank_small") / "images"


def _frame(folder, names):
    folder.mkdir(parents=True)
    for name in names:
        shutil.copy(IMAGES / name, folder)


@pytest.mark.slow
def test_each_moment_is_made_dense_by_the_cameras_of_the_run(torchrefrac, part_of_tank, metrics, tmp_path):
    capture = part_of_tank([0, 1, 2, 3])
    first = torchrefrac("scene=capture", f"scene.path={capture}", "features.max_features=1500", "out=run")
    assert first.status == 0, first.err
    names = sorted(path.name for path in (capture / "images").iterdir())
    _frame(tmp_path / "film" / "t1" / "images", names)
    _frame(tmp_path / "film" / "t2", names[:3])
    _frame(tmp_path / "film" / "t3", names[:1])

    ended = torchrefrac(
        "densify", "run=run", "frames='film/*'", "out=dense", "executor.workers=1", "outputs.depth_maps=false"
    )

    assert ended.status == 1  # because of one of them
    assert "2 of 3 frames are dense" in ended.out
    rows = list(csv.DictReader((tmp_path / "dense" / "frames.csv").read_text().splitlines()))
    assert [(row["frame"], row["status"]) for row in rows] == [("t1", "complete"), ("t2", "complete"), ("t3", "failed")]
    assert "has photographs of 1 of the cameras of the run, but two are needed" in rows[2]["reason"]
    assert int(rows[0]["dense_points"]) > int(rows[1]["dense_points"]) > 1000
    assert metrics(tmp_path / "dense" / "t1")["status"] == "complete"
    assert (tmp_path / "dense" / "t1" / "dense.ply").is_file()
    assert not (tmp_path / "dense" / "t3").exists()
    assert not (tmp_path / "run" / "dense.ply").exists()


def test_photographs_are_told_apart_by_their_folders(draw, tmp_path):
    """As those of a rig, whose cameras number their photographs alike."""
    scene = two_camera_scene(draw, views=3)
    names = ("left/1.jpg", "right/1.jpg", "top.jpg")
    down = torch.tensor([[0.0, 0.0, 1.0]]).double().repeat(3, 1)
    numbers = {"down_in_cam": down, "down_sigma": torch.ones(3).double(), "height": torch.ones(3).double()}
    files = tuple(tmp_path / name for name in names)
    capture = Capture(
        tmp_path, names, files, scene.cameras, scene.interfaces, **numbers, has_height=torch.zeros(3, dtype=torch.bool),
        length_unit="cm", camera=scene.views.camera,
    )  # fmt: skip
    scene = replace(scene, capture=capture, views=replace(scene.views, names=names))
    for name in ("left/1.png", "right/1.png", "other.png"):
        (tmp_path / "t1" / "images" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "t1" / "images" / name).write_bytes(b"")

    found = of_frame(scene, tmp_path / "t1")

    assert found.views.names == names[:2]
    assert [path.relative_to(tmp_path / "t1" / "images").as_posix() for path in found.capture.paths] == [
        "left/1.png",
        "right/1.png",
    ]


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (("frames=film", "run=run"), "out is missing"),
        (("out=dense", "run=run"), "frames is missing"),
        (("frames=film", "out=dense", "run=nowhere"), "run is nowhere, which is no folder"),
        (("frames=film", "out=dense", "run=run", "executor.workers=-1"), "executor.workers is -1"),
    ],
)
def test_what_cannot_be_right_is_refused(torchrefrac, tmp_path, options, sentence):
    (tmp_path / "run").mkdir()

    ended = torchrefrac("densify", *options)

    assert ended.status == 1
    assert sentence in " ".join(ended.err.split())
    assert not (tmp_path / "dense").exists()
