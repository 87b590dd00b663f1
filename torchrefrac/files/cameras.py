"""`cameras.json` and `points.ply`: what a run leaves behind, written whole or not at all."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchrefrac.atomic import replacing
from torchrefrac.camera import Intrinsics
from torchrefrac.files.ply import write_vertices
from torchrefrac.scene.reconstruction import Assessment, Reconstruction, mean_deviation

FORMAT = "torchrefrac-cameras/1"


def write_cameras(reconstruction: Reconstruction, path: Path) -> None:
    """Write poses, intrinsics, index ratio and, where it is known, the covariance (3, 3) of each registered image's
    centre, in squares of the length unit; the frame and the convention of pixels are those of the package."""
    focal, principal, intrinsics = (
        reconstruction.intrinsics.focal.tolist(),
        reconstruction.intrinsics.principal_point.tolist(),
        reconstruction.intrinsics,
    )
    covariance = reconstruction.assessment.center_covariance
    spread = iter([] if covariance is None else covariance.tolist())
    images = []
    for i, name in enumerate(reconstruction.names):
        entry: dict[str, object] = {"name": name, "registered": bool(reconstruction.registered[i])}
        if entry["registered"]:
            entry["cam_from_world_rotation"] = reconstruction.rotation[i].tolist()
            entry["center_in_world"] = reconstruction.center[i].tolist()
            if covariance is not None:
                entry["center_covariance"] = next(spread)
        else:
            entry["reason"] = reconstruction.failures.get(name, "")
        images.append(entry)
    content = {
        "format": FORMAT,
        "length_unit": reconstruction.length_unit,
        "index_ratio": reconstruction.index_ratio,
        "pixel_origin": "corner",
        "intrinsics": {
            "width": intrinsics.width,
            "height": intrinsics.height,
            "fx": focal[0],
            "fy": focal[1],
            "cx": principal[0],
            "cy": principal[1],
            "distortion": intrinsics.distortion.tolist(),
        },
        "images": images,
    }
    with replacing(path) as temporary:
        temporary.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def load_cameras(path: Path) -> Reconstruction:
    """Read `cameras.json` back; the reconstruction has no points, and of its assessment only that of the centres."""
    content = json.loads(path.read_text(encoding="utf-8"))
    lens = content["intrinsics"]
    images = content["images"]
    registered = torch.tensor([image["registered"] for image in images])
    rotation = torch.eye(3, dtype=torch.float64).repeat(len(images), 1, 1)
    center = torch.zeros(len(images), 3, dtype=torch.float64)
    for i, image in enumerate(images):
        if image["registered"]:
            rotation[i] = torch.tensor(image["cam_from_world_rotation"], dtype=torch.float64)
            center[i] = torch.tensor(image["center_in_world"], dtype=torch.float64)
    empty = torch.zeros(0, dtype=torch.long)
    return Reconstruction(
        names=tuple(image["name"] for image in images),
        registered=registered,
        rotation=rotation,
        center=center,
        intrinsics=Intrinsics.create(
            lens["width"], lens["height"], (lens["fx"], lens["fy"]), (lens["cx"], lens["cy"]), lens["distortion"]
        ),
        index_ratio=content["index_ratio"],
        length_unit=content["length_unit"],
        points=torch.zeros(0, 3, dtype=torch.float64),
        colors=torch.zeros(0, 3, dtype=torch.uint8),
        image=empty,
        point=empty,
        pixels=torch.zeros(0, 2, dtype=torch.float64),
        failures={image["name"]: image.get("reason", "") for image in images if not image["registered"]},
        assessment=_assessment([image for image in images if image["registered"]]),
    )


def _assessment(placed: list[dict[str, Any]]) -> Assessment:
    """Of the centres of registered images, where the file tells of all of them."""
    if not placed or not all("center_covariance" in image for image in placed):
        return Assessment()
    covariance = torch.tensor([image["center_covariance"] for image in placed], dtype=torch.float64)
    return Assessment(center_sigma=mean_deviation(covariance), center_covariance=covariance)


def write_points(points: Tensor, colors: Tensor, path: Path, sigma: Tensor | None = None) -> None:
    """Write a coloured point cloud (n, 3), (n, 3) uint8 as binary PLY.

    sigma (n): standard deviations of the points, written as the property `sigma` of the vertices (float32).
    """
    columns = [(name, "f4", value) for name, value in zip("xyz", points.T, strict=True)]
    columns += [(name, "u1", value) for name, value in zip(("red", "green", "blue"), colors.T, strict=True)]
    if sigma is not None:
        columns.append(("sigma", "f4", sigma))
    write_vertices(columns, path)


def load_points(path: Path) -> tuple[Tensor, Tensor]:
    """Points (n, 3) float64 and colours (n, 3) uint8 of a PLY file."""
    import trimesh  # noqa: PLC0415 - slow to import, needed only here

    cloud = trimesh.load(path, process=False)
    colors = np.asarray(cloud.visual.vertex_colors if hasattr(cloud, "visual") else cloud.colors)  # type: ignore[union-attr]
    points = torch.from_numpy(np.array(cloud.vertices, dtype=np.float64))  # type: ignore[union-attr]
    return points, torch.from_numpy(np.array(colors[:, :3], dtype=np.uint8))
