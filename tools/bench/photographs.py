"""Real photographs through the flat wall of a water tank: chessboard corners triangulated with and without refraction.

    python tools/bench/photographs.py FOLDER

FOLDER holds two_view_points.json: for each view K, k1 and k2, R, centre and the corners' pixels (OpenCV convention),
and the true corners in millimetres. Prints the mean distance of the triangulated corners from the true ones.
"""

import json
from pathlib import Path
from typing import Any

import torch
from baseline import bench_parser, figure

import torchrefrac as tr


def main() -> None:
    parser = bench_parser("Triangulation error on real photographs.")
    parser.add_argument("folder", type=Path, help="folder with two_view_points.json")
    data = json.loads((parser.parse_args().folder / "two_view_points.json").read_text(encoding="utf-8"))
    truth = torch.tensor(data["points"], dtype=torch.float64)
    for label, ratio in (("with refraction", data["n_water"]), ("without refraction", 1.0)):
        rays = [_rays(view, ratio) for view in data["views"]]
        origins, directions = (torch.stack(part, dim=1) for part in zip(*rays, strict=True))
        points, _ = tr.minimal.triangulate(origins, directions)
        error = (points - truth).norm(dim=-1)
        print(f"{label:<20} mean error {error.mean():6.2f} mm, worst {error.max():6.2f} mm, {len(truth)} corners")
        if ratio > 1.0:
            figure(f"{label}: mean error", float(error.mean()), "mm", "lower")


def _rays(view: dict[str, Any], index_ratio: float) -> tuple[torch.Tensor, torch.Tensor]:
    matrix, (k1, k2) = view["K"], view["dist_k1k2"]
    intrinsics = tr.Intrinsics.create(
        width=int(2 * matrix[0][2]),
        height=int(2 * matrix[1][2]),
        focal=(matrix[0][0], matrix[1][1]),
        principal_point=(matrix[0][2] + 0.5, matrix[1][2] + 0.5),
        distortion=(k1, k2, 0.0, 0.0, 0.0),
    )
    rotation, center, pixels = (torch.tensor(view[key], dtype=torch.float64) for key in ("R", "c", "uv"))
    camera = tr.RefractiveCamera(intrinsics, rotation, center, tr.FlatInterface(index_ratio))
    origins, directions, _ = camera.cast_rays(pixels + 0.5)
    return origins, directions


if __name__ == "__main__":
    main()
