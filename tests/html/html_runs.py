"""Run folders to make reports of, planted on the embedded tank: no photograph is looked at, and nothing is adjusted."""

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

from torchrefrac.camera import RefractiveCamera
from torchrefrac.files.cameras import write_cameras, write_points
from torchrefrac.files.capture import load_capture
from torchrefrac.files.library import embedded_scene
from torchrefrac.files.tracks import write_tracks
from torchrefrac.files.truth import load_truth
from torchrefrac.geometry import Rigid
from torchrefrac.refraction import FlatInterface
from torchrefrac.scene import Assessment, Interfaces, Observations, Scene

COMPLETE = {
    "status": "complete", "stages": ["features", "matching", "sparse"], "images": 8, "registered_images": 7,
    "points": 300, "reprojection_median_px": 0.123, "seconds_features": 1.5, "seconds_matching": 10.25,
    "seconds_sparse": 70.0, "seconds_total": 83.0, "camera_rms_cm": 0.01234, "point_median_cm": 0.0456,
    "flatness_cm": 0.0321, "surface_median_cm": 0.0432, "gravity": "measured", "gravity_sigma_deg": 0.5,
    "peak_memory_gib": 1.234, "true_index_ratio": 1.33, "scene": "tank_small",
    "determined": ["index ratio: determined to 0.00032", "scale, relative: not determined"],
    "held": {"focal": "focal: not determined by these photographs"},
}  # fmt: skip
LOST = "sees too few points <b>of the others</b>"


@dataclass(frozen=True)
class Planted:
    """Makes run folders in `folder`."""

    folder: Path
    generator: torch.Generator

    def complete(self, name: str, model: str = "refractive", **fields: Any) -> Path:
        """A finished run: true cameras but for a hundredth of a centimetre, points on the true planes, and half a pixel
        of noise; the last image is not registered."""
        run = self.folder / name
        scene = self.scene(1.33 if model == "refractive" else 1.0)
        write_cameras(scene, run / "cameras.json")
        write_points(scene.points, scene.colors, run / "points.ply")
        write_tracks(scene, run / "tracks.npz")
        ratio = {"index_ratio": scene.index_ratio}
        told = {"overrides": {"scene": "tank_small", "model": model}}
        self._write(
            run, COMPLETE | ratio | told | {"model": model, "capture": str(embedded_scene("tank_small"))} | fields
        )
        (run / ".hydra").mkdir()
        (run / ".hydra" / "config.yaml").write_text("model:\n  name: <refractive>\n")
        (run / ".hydra" / "overrides.yaml").write_text("- model=refractive\n")
        return run

    def ended(self, name: str, **fields: Any) -> Path:
        """A run without any results."""
        run = self.folder / name
        run.mkdir(parents=True)
        self._write(run, fields)
        return run

    def scene(self, index_ratio: float, count: int = 300) -> Scene:
        """What `complete` writes."""
        place = embedded_scene("tank_small")
        truth, intrinsics = load_truth(place), load_capture(place).cameras[0]
        if truth is None:
            raise ValueError("the embedded scene has lost its truth")
        cameras = RefractiveCamera(intrinsics, truth.rotation, truth.center, FlatInterface(1.33))
        plane = torch.randint(len(truth.corner), (count,), generator=self.generator)
        along = torch.rand(count, 2, 1, generator=self.generator, dtype=torch.float64)
        points = truth.corner[plane] + along[:, 0] * truth.edge1[plane] + along[:, 1] * truth.edge2[plane]
        pixels, seen = cameras[:, None].project(points, inside_image=True)
        pixels = pixels + 0.5 * torch.randn(pixels.shape, generator=self.generator, dtype=torch.float64)
        registered = torch.arange(len(truth.names)) < len(truth.names) - 1
        point, view = (seen & registered[:, None]).T.nonzero(as_tuple=True)
        spread = 1e-4 * torch.diag(torch.tensor((1.0, 2.0, 4.0), dtype=torch.float64))
        shift = 0.01 * torch.randn(truth.center.shape, generator=self.generator, dtype=torch.float64)
        scene = Scene.create(
            Rigid(truth.rotation, truth.center + shift),
            intrinsics,
            Interfaces.level(index_ratio),
            points,
            Observations(view, point, pixels[view, point]),
            names=truth.names,
            colors=torch.zeros(count, 3, dtype=torch.uint8),
            length_unit="cm",
        )
        return replace(
            scene,
            views=replace(scene.views, registered=registered),
            failures={truth.names[-1]: LOST},
            assessment=Assessment(center_covariance=spread.expand(int(registered.sum()), 3, 3)),
        )

    def _write(self, run: Path, metrics: dict[str, Any]) -> None:
        (run / "metrics.json").write_text(json.dumps(metrics))
