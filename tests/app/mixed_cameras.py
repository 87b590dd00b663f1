"""The embedded scene as several cameras would have taken it: some photographs at half their size, some turned."""

import json
from pathlib import Path

import cv2

from torchrefrac.files.library import embedded_scene

QUARTER_TURN = [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
"""From a camera's axes to those of the same camera whose image was turned clockwise."""


def write_mixed_cameras(folder, images, halves=(), turned=(), change=lambda camera: camera):
    """A capture of these photographs, with the truth beside it. `change` gets the description of each camera."""
    source = embedded_scene("tank_small")
    given, truth = (json.loads((source / name).read_text()) for name in ("capture.json", "truth.json"))
    (folder / "images").mkdir(parents=True)
    cameras, listed, true = {}, [], []
    for i in images:
        image, known = dict(given["images"][i]), dict(truth["images"][i])
        picture = cv2.imread(str(source / "images" / image["name"]))
        lens = given["intrinsics"]
        focal, cx, cy = lens["fx"], lens["cx"] + 0.5, lens["cy"] + 0.5
        if i in halves:
            picture = cv2.resize(picture, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
            focal, cx, cy = focal / 2.0, cx / 2.0, cy / 2.0
        if i in turned:
            cx, cy = picture.shape[0] - cy, cx
            picture = cv2.rotate(picture, cv2.ROTATE_90_CLOCKWISE)
            image["down_in_cam"] = _turned(image["down_in_cam"])
            columns = zip(*known["cam_from_world_rotation"], strict=True)
            known["cam_from_world_rotation"] = [list(row) for row in zip(*map(_turned, columns), strict=True)]
        height, width = picture.shape[:2]
        name = f"{width}x{height}"
        image["name"] = known["name"] = Path(image["name"]).with_suffix(".png").name
        cameras[name] = change({"width": width, "height": height, "fx": focal, "fy": focal, "cx": cx, "cy": cy})
        cv2.imwrite(str(folder / "images" / image["name"]), picture)
        listed.append({**image, "camera": name})
        true.append(known)
    kept = {name: given[name] for name in ("length_unit", "index_ratio", "down_in_cam_sigma_deg")}
    about = {"format": "torchrefrac-capture/2", **kept, "pixel_origin": "corner", "cameras": cameras, "images": listed}
    (folder / "capture.json").write_text(json.dumps(about))
    (folder / "truth.json").write_text(json.dumps({**truth, "images": true}))
    return folder


def _turned(vector):
    return [sum(a * b for a, b in zip(row, vector, strict=True)) for row in QUARTER_TURN]
