"""The table of the cameras of a run: what was stated of them, and what was found."""

from dataclasses import replace
from pathlib import Path

import torch

from torchrefrac import load_capture
from torchrefrac.camera import Intrinsics
from torchrefrac.files.library import embedded_scene
from torchrefrac.files.run import RunRecord
from torchrefrac.html.contents import RunContents
from torchrefrac.html.tables import cameras
from torchrefrac.scene import Cameras, Observations, Scene


def test_each_camera_has_a_row_with_what_was_found():
    capture = load_capture(embedded_scene("tank_small"))
    lenses = [Intrinsics.create(640, 480, 400.0), Intrinsics.create(48, 64, 30.0, model="fisheye")]
    table = replace(Cameras.of(lenses, ("phone", "gopro")), focal_sigma=torch.tensor([4.0 / 400.0, 0.0]).double())
    mixed = replace(capture, cameras=table, camera=torch.arange(8) % 2)
    metrics = {"camera_phone_focal_px": 417.03, "camera_phone_focal_sigma_px": 0.2}
    none = torch.zeros(0, dtype=torch.uint8).view(0, 3)
    scene = Scene.of_capture(mixed, Observations.none(), none, 1.33)
    placed = torch.arange(8) % 4 < 2
    scene = replace(scene, views=replace(scene.views, registered=placed))
    contents = RunContents(RunRecord(Path(), metrics=metrics), scene=scene, capture=mixed)

    found = cameras(contents)

    assert [[cell.text for cell in row] for row in found.rows] == [
        ["phone", "opencv", "640 \u00d7 480", "2 of 4", "400 \u00b1 4", "417.0 \u00b1 0.2"],
        ["gopro", "fisheye", "48 \u00d7 64", "2 of 4", "30.000", "as stated"],
    ]
    unused = replace(contents, scene=replace(scene, views=replace(scene.views, registered=torch.arange(8) % 2 == 0)))
    assert [[cell.text for cell in row[3:]] for row in cameras(unused).rows] == [
        ["4 of 4", "400 \u00b1 4", "417.0 \u00b1 0.2"],
        ["0 of 4", "30.000", "not used"],
    ]
    assert cameras(replace(contents, scene=None)).rows[0][3].text == "4"
    assert cameras(replace(contents, capture=capture)) is None
