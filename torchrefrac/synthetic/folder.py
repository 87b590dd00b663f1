"""The folder of a made scene: photographs, what its user would know, and the truth."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from torchrefrac.atomic import remove_unfinished, replacing
from torchrefrac.camera import Intrinsics
from torchrefrac.files.capture import FORMAT as CAPTURE_FORMAT
from torchrefrac.files.capture import SEVERAL
from torchrefrac.files.intrinsics import intrinsics_content
from torchrefrac.files.mesh import write_mesh
from torchrefrac.files.metadata.dji_tags import write_with_tags
from torchrefrac.files.survey import FORMAT as SURVEY_FORMAT
from torchrefrac.files.truth import POINTS_FILE
from torchrefrac.geometry.surfaces import Rectangle
from torchrefrac.recorder import Recorder
from torchrefrac.synthetic.attitude import Attitude, measure_attitude, measure_positions
from torchrefrac.synthetic.drone import drone_tags
from torchrefrac.synthetic.glass import interface_content
from torchrefrac.synthetic.options import SyntheticOptions
from torchrefrac.synthetic.photograph import Photographer, develop
from torchrefrac.synthetic.stage import Stage, StageError

TRUTH_FORMAT = "torchrefrac-truth/1"
SCENE_FORMAT = "torchrefrac-scene/1"
STEP = 4
OFFSET = 2  # of the first true point, in pixels from the centre of the first
SURFACE_FILE = "truth_surface.ply"


def image_names(count: int) -> tuple[str, ...]:
    """Of the photographs, in the order of the path."""
    digits = max(2, len(str(count - 1)))
    return tuple(f"cam{i:0{digits}d}.png" for i in range(count))


def render_into(
    folder: Path,
    photographers: Sequence[Photographer],
    options: SyntheticOptions,
    version: int,
    recorder: Recorder,
) -> None:
    """Write all files of a scene, of which `photographers` take the photographs in turn; images that are there already
    are whole, and stay.

    Raises StageError where by its measured gravity a camera looks at the sky: captures of these are refused.
    """
    stage = photographers[0].stage
    remove_unfinished(folder, "**/")
    names = image_names(len(stage.center))
    attitude = measure_attitude(stage.rotation, options)
    if options.at_surface:
        _require_down(attitude, names, options)
    intrinsics = [photographer.intrinsics for photographer in photographers]
    capture = _capture(stage, options, intrinsics, attitude)
    sigma = stage.position_sigma
    if sigma is not None:
        positions = dict(zip(names, measure_positions(stage.center, sigma, options.seed).tolist(), strict=True))
        for image in capture["images"]:
            if capture["format"] == CAPTURE_FORMAT:
                image["center_prior"] = positions[image["name"]]
            else:
                image |= {"position": positions[image["name"]], "position_sigma": sigma}
        measured = {name: {"center": position, "center_sigma": sigma} for name, position in positions.items()}
        _write_json({"format": SURVEY_FORMAT, "images": measured}, folder / "survey.json")
    scene = {"format": SCENE_FORMAT, "version": version, "options": options.fingerprint()}
    _write_json(scene, folder / "scene.json")
    _write_json(capture, folder / "capture.json")
    _write_json(_truth(stage, options, attitude), folder / "truth.json")
    tags = drone_tags(stage, intrinsics, options) if options.metadata == "drone" else None
    for image, name in recorder.track(enumerate(names), len(names), f"rendering {options.label}", "image"):
        path = folder / "images" / name
        if not path.is_file():
            light = photographers[image % len(photographers)].take(image)
            taken = develop(light, options.sensor, options.seed, image)
            write_photograph(taken, path) if tags is None else write_with_tags(taken, tags[image], path)
    _write_truth_points(photographers, folder / POINTS_FILE)
    _write_surface(stage, folder / SURFACE_FILE)


def _require_down(attitude: Attitude, names: Sequence[str], options: SyntheticOptions) -> None:
    """Refuse cameras over water that by their measured gravity look at the sky."""
    if attitude.down_in_cam is None:
        return
    for name, depth in zip(names, attitude.down_in_cam[:, 2].tolist(), strict=True):
        if depth <= 0.0:
            raise StageError(
                f"scene {options.name}: by its measured gravity {name} looks at the sky; point the cameras further "
                "down, or give smaller errors in inertial"
            )


def write_photograph(image: UInt8[np.ndarray, "height width 3"], path: Path) -> None:
    """Write RGB as PNG."""
    _, encoded = cv2.imencode(".png", cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
    with replacing(path) as temporary:
        temporary.write_bytes(encoded.tobytes())


def _write_json(content: dict[str, Any], path: Path) -> None:
    with replacing(path) as temporary:
        temporary.write_text(json.dumps(content, indent=1), encoding="utf-8")


def _capture(
    stage: Stage, options: SyntheticOptions, intrinsics: Sequence[Intrinsics], attitude: Attitude
) -> dict[str, Any]:
    """`capture.json`: the interface is the true one, only the first height above the water, or distance from a wall, is
    measured. intrinsics: of the cameras that take the photographs in turn."""
    several = len(intrinsics) > 1
    is_plain = options.at_surface and attitude.down_in_cam is not None and not several
    images: list[dict[str, Any]] = []
    for i, name in enumerate(image_names(len(stage.center))):
        image: dict[str, Any] = {"name": name}
        if attitude.down_in_cam is not None:
            image["down_in_cam"] = attitude.down_in_cam[i].tolist()
        if attitude.heading is not None:
            image["heading_deg"] = float(attitude.heading[i].rad2deg())
        if several:
            image["camera"] = str(i % len(intrinsics))
        if i == 0 and options.interface.kind != "port":
            image["height"] = float(stage.center[i, 2])
        images.append(image)
    lenses: dict[str, Any] = {"cameras": {str(i): intrinsics_content(camera) for i, camera in enumerate(intrinsics)}}
    if is_plain:
        lenses = {"intrinsics": intrinsics_content(intrinsics[0])}
    gravity = {} if attitude.down_in_cam is None else {"down_in_cam_sigma_deg": attitude.sigma_deg}
    return {
        **{"format": CAPTURE_FORMAT if is_plain else SEVERAL, "length_unit": stage.length_unit},
        **interface_content(options),
        **{"pixel_origin": "corner", **lenses, **gravity, "images": images},
    }


def _truth(stage: Stage, options: SyntheticOptions, attitude: Attitude) -> dict[str, Any]:
    """`truth.json`: cameras, the planes on which flatness can be measured, the interface and the surface's file."""
    cameras = zip(image_names(len(stage.center)), stage.rotation, stage.center, attitude.true_down, strict=True)
    return {
        **{"format": TRUTH_FORMAT, "length_unit": stage.length_unit, **interface_content(options)},
        "surface": SURFACE_FILE,
        **({"water_extent": [list(corner) for corner in stage.water_extent]} if stage.water_extent else {}),
        "images": [
            {
                **{"name": name, "cam_from_world_rotation": rotation.tolist(), "center_in_world": center.tolist()},
                "down_in_cam": down.tolist(),
            }
            for name, rotation, center, down in cameras
        ],
        "planes": [
            {
                **{"name": stage.pieces[i].name, "origin": plane.corner.tolist()},
                **{"e1": plane.edge1.tolist(), "e2": plane.edge2.tolist()},
            }
            for i, plane in _planes(stage).items()
        ],
    }


def _planes(stage: Stage) -> dict[int, Rectangle]:
    """The pieces that are planes of truth.json, by their index."""
    surfaces = ((i, piece.surface) for i, piece in enumerate(stage.pieces) if piece.is_plane)
    return {i: surface for i, surface in surfaces if isinstance(surface, Rectangle)}


def _write_truth_points(photographers: Sequence[Photographer], path: Path) -> None:
    """Write `truth_points.npz`: what every fourth pixel of every fourth row truly sees, at its centre; nothing beyond
    an image that is smaller than others."""
    stage, grids = photographers[0].stage, [_pixels(photographer.intrinsics) for photographer in photographers]
    rows, columns = (max(grid.shape[axis] for grid in grids) for axis in (0, 1))
    planes, plane_of_piece = _planes(stage), torch.full((len(stage.pieces) + 1,), -1)
    plane_of_piece[list(planes)] = torch.arange(len(planes))
    points = np.full((len(stage.center), rows, columns, 3), np.nan, dtype=np.float32)
    plane = np.full(points.shape[:3], -1, dtype=np.int16)
    for image in range(len(points)):
        grid = grids[image % len(grids)]
        sight, (height, width) = photographers[image % len(grids)].look(image, grid.flatten(0, 1)), grid.shape[:2]
        points[image, :height, :width] = sight.points.reshape(height, width, 3).numpy()
        plane[image, :height, :width] = plane_of_piece[sight.piece].reshape(height, width).numpy()
    with replacing(path) as temporary:
        np.savez_compressed(temporary, X=points, plane=plane, step=np.array(STEP), offset=np.array(float(OFFSET)))


def _pixels(intrinsics: Intrinsics) -> Float[Tensor, "rows columns 2"]:
    """Centres of every fourth pixel of every fourth row."""
    columns, rows = (range(min(OFFSET, size - 1), size, STEP) for size in (intrinsics.width, intrinsics.height))
    x, y = (torch.tensor(numbers, dtype=torch.float64) + 0.5 for numbers in (columns, rows))
    return torch.stack((x.expand(len(rows), -1), y[:, None].expand(-1, len(columns))), dim=-1)


def _write_surface(stage: Stage, path: Path) -> None:
    """Write the triangles of all pieces."""
    import trimesh  # noqa: PLC0415 - slow to import

    vertices, faces = zip(*(piece.surface.triangles() for piece in stage.pieces), strict=True)
    first = np.cumsum([0, *map(len, vertices[:-1])]).tolist()
    faces = torch.cat([own + start for own, start in zip(faces, first, strict=True)])
    write_mesh(trimesh.Trimesh(torch.cat(vertices).numpy(), faces.numpy(), process=False), path)
