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

from torchrefrac.atomic import replacing
from torchrefrac.camera import Intrinsics
from torchrefrac.files.capture import FORMAT as CAPTURE_FORMAT
from torchrefrac.files.mesh import write_mesh
from torchrefrac.files.survey import FORMAT as SURVEY_FORMAT
from torchrefrac.geometry.surfaces import Rectangle
from torchrefrac.synthetic.attitude import Attitude
from torchrefrac.synthetic.options import SyntheticOptions
from torchrefrac.synthetic.photograph import Photographer
from torchrefrac.synthetic.stage import Piece, Stage

TRUTH_FORMAT = "torchrefrac-truth/1"
SCENE_FORMAT = "torchrefrac-scene/1"
STEP = 4
OFFSET = 2  # of the first true point, in pixels from the centre of the first
SURFACE_FILE = "truth_surface.ply"


def image_names(count: int) -> tuple[str, ...]:
    """Of the photographs, in the order of the path."""
    digits = max(2, len(str(count - 1)))
    return tuple(f"cam{i:0{digits}d}.png" for i in range(count))


def write_photograph(image: UInt8[np.ndarray, "height width 3"], path: Path) -> None:
    """Write RGB as PNG."""
    _, encoded = cv2.imencode(".png", cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
    with replacing(path) as temporary:
        temporary.write_bytes(encoded.tobytes())


def write_json(content: dict[str, Any], path: Path) -> None:
    with replacing(path) as temporary:
        temporary.write_text(json.dumps(content, indent=1), encoding="utf-8")


def capture_content(
    stage: Stage,
    options: SyntheticOptions,
    intrinsics: Intrinsics,
    attitude: Attitude,
    positions: Float[Tensor, "m 3"] | None,
) -> dict[str, Any]:
    """`capture.json`: the index ratio is the true one, only the first height above the water is measured."""
    images: list[dict[str, Any]] = []
    focal, principal_point = intrinsics.focal.tolist(), intrinsics.principal_point.tolist()
    for i, name in enumerate(image_names(len(stage.center))):
        image: dict[str, Any] = {"name": name, "down_in_cam": attitude.down_in_cam[i].tolist()}
        if attitude.heading is not None:
            image["heading_deg"] = float(attitude.heading[i].rad2deg())
        if i == 0:
            image["height"] = float(stage.center[i, 2])
        if positions is not None:
            image["center_prior"] = positions[i].tolist()
        images.append(image)
    return {
        "format": CAPTURE_FORMAT,
        "length_unit": stage.length_unit,
        "index_ratio": options.index_ratio,
        "pixel_origin": "corner",
        "intrinsics": {
            "width": intrinsics.width,
            "height": intrinsics.height,
            **dict(zip(("fx", "fy", "cx", "cy"), (*focal, *principal_point), strict=True)),
            "distortion": intrinsics.distortion.tolist(),
        },
        "down_in_cam_sigma_deg": attitude.sigma_deg,
        "images": images,
    }


def truth_content(stage: Stage, options: SyntheticOptions, attitude: Attitude) -> dict[str, Any]:
    """`truth.json`: cameras, the planes on which flatness can be measured, index ratio and the surface's file."""
    return {
        "format": TRUTH_FORMAT,
        "length_unit": stage.length_unit,
        "index_ratio": options.index_ratio,
        "surface": SURFACE_FILE,
        "images": [
            {
                "name": name,
                "cam_from_world_rotation": stage.rotation[i].tolist(),
                "center_in_world": stage.center[i].tolist(),
                "down_in_cam": attitude.true_down[i].tolist(),
            }
            for i, name in enumerate(image_names(len(stage.center)))
        ],
        "planes": [
            {
                "name": piece.name,
                "origin": piece.surface.corner.tolist(),
                "e1": piece.surface.edge1.tolist(),
                "e2": piece.surface.edge2.tolist(),
            }
            for piece in stage.pieces
            if isinstance(piece.surface, Rectangle) and piece.is_plane
        ],
    }


def survey_content(positions: Float[Tensor, "m 3"], sigma: float) -> dict[str, Any]:
    """`survey.json`: the satellite positions of all images."""
    names = image_names(len(positions))
    return {
        "format": SURVEY_FORMAT,
        "images": {name: {"center": positions[i].tolist(), "center_sigma": sigma} for i, name in enumerate(names)},
    }


def options_content(options: SyntheticOptions, version: int) -> dict[str, Any]:
    """`scene.json`: what decides everything in the folder."""
    return {"format": SCENE_FORMAT, "version": version, "options": options.fingerprint()}


def write_truth_points(photographer: Photographer, path: Path) -> None:
    """Write `truth_points.npz`: what every fourth pixel of every fourth row truly sees, at its centre."""
    stage, intrinsics = photographer.stage, photographer.intrinsics
    columns, rows = (range(min(OFFSET, size - 1), size, STEP) for size in (intrinsics.width, intrinsics.height))
    x, y = (torch.tensor(numbers, dtype=torch.float64) + 0.5 for numbers in (columns, rows))
    pixels = torch.stack((x.expand(len(rows), -1), y[:, None].expand(-1, len(columns))), dim=-1).flatten(0, 1)
    plane_of_piece = torch.tensor([*_plane_numbers(stage.pieces), -1])
    points = np.empty((len(stage.center), len(rows), len(columns), 3), dtype=np.float32)
    plane = np.empty(points.shape[:3], dtype=np.int16)
    for image in range(len(points)):
        sight = photographer.look(image, pixels)
        points[image] = sight.points.reshape(points.shape[1:]).numpy()
        plane[image] = plane_of_piece[sight.piece].reshape(plane.shape[1:]).numpy()
    with replacing(path) as temporary:
        np.savez_compressed(temporary, X=points, plane=plane, step=np.array(STEP), offset=np.array(float(OFFSET)))


def write_surface(stage: Stage, path: Path) -> None:
    """Write the triangles of all pieces."""
    import trimesh  # noqa: PLC0415 - slow to import

    vertices: list[Tensor] = []
    faces: list[Tensor] = []
    count = 0
    for piece in stage.pieces:
        own_vertices, own_faces = piece.surface.triangles()
        vertices.append(own_vertices)
        faces.append(own_faces + count)
        count += len(own_vertices)
    write_mesh(trimesh.Trimesh(torch.cat(vertices).numpy(), torch.cat(faces).numpy(), process=False), path)


def _plane_numbers(pieces: Sequence[Piece]) -> list[int]:
    """For each piece its index among the planes of truth.json, -1 where it is none."""
    numbers: list[int] = []
    count = 0
    for piece in pieces:
        is_plane = piece.is_plane and isinstance(piece.surface, Rectangle)
        numbers.append(count if is_plane else -1)
        count += is_plane
    return numbers
