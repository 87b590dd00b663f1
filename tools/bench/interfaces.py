"""An aquarium through its wall of glass and a reef through the port of a housing, against their truth, and what it
costs to leave something of it out.

    python tools/bench/interfaces.py [aquarium] [housing] [--only NAME ...] [--folder FOLDER]

Both scenes are made and rendered (`scene=aquarium`, `scene=housing`), and reconstructed from captures that state more
or less: without the glass, without gravity, without any distance from the glass; with a port that is stated wrongly by
5 mm and 2 degrees, and to be so uncertain; and the dive with a pinhole whose focal length and radial distortion are
free. Cameras are compared after an alignment in four degrees of freedom before a wall, after a similarity otherwise.
"""

import argparse
import json
import math
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from baseline import bench_parser, figure

from torchrefrac.files.truth import load_truth
from torchrefrac.geometry import so3_exp

Content = dict[str, Any]
DENSE = ("dense=patch",)


def _without_glass(content: Content) -> None:
    del content["interface"]["layers"][1]


def _without_gravity(content: Content) -> None:
    for image in content["images"]:
        image.pop("down_in_cam", None)
    content.pop("down_in_cam_sigma_deg", None)


def _without_distance(content: Content) -> None:
    for image in content["images"]:
        image.pop("height", None)


def _as_surface(content: Content) -> None:
    content["interface"] = {"kind": "surface", "index_ratio": 1.0}


def _port_off(content: Content) -> None:
    port = content["interface"]
    turn = so3_exp(torch.tensor((math.radians(2.0), 0.0, 0.0), dtype=torch.float64))
    normal = turn @ torch.tensor(port["normal_in_cam"], dtype=torch.float64)
    port |= {"normal_in_cam": normal.tolist(), "distance": port["distance"] + 0.5}
    port |= {"distance_sigma": 0.5, "tilt_sigma_deg": 2.0}


def _as_it_is(content: Content) -> None:
    """Nothing is left out."""


AQUARIUM: dict[str, tuple[Callable[[Content], None], tuple[str, ...]]] = {
    "as it is": (_as_it_is, DENSE),
    "without glass": (_without_glass, ()),
    "without gravity": (_without_gravity, ()),
    "without distance": (_without_distance, ()),
}
HOUSING: dict[str, tuple[Callable[[Content], None], tuple[str, ...]]] = {
    "as it is": (_as_it_is, ()),
    "port off": (_port_off, ()),
    "pinhole": (_as_surface, ("model=radial", "sfm.bundle.refine=[focal]")),
}
SCENES = {"aquarium": AQUARIUM, "housing": HOUSING}


def main() -> None:
    parser = bench_parser("Walls and ports against their truth.")
    parser.add_argument("scenes", nargs="*", default=[], help="by default both")
    parser.add_argument("--only", nargs="*", default=[], help="names of what is stated, by default all")
    parser.add_argument("--folder", type=Path, help="where all files stay")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        for scene in options.scenes or SCENES:
            _measure(scene, options, options.folder or Path(temporary))


def _measure(scene: str, options: argparse.Namespace, folder: Path) -> None:
    made = _made(scene, folder)
    truth = load_truth(made)
    assert truth is not None
    extent = float((truth.center - truth.center.mean(dim=0)).norm(dim=-1).max()) * 2.0
    print(f"{scene}: {len(truth.names)} photographs, cameras within {extent:.0f} {truth.length_unit}")
    for name, (change, given) in SCENES[scene].items():
        if options.only and name not in options.only:
            continue
        metrics = _reconstructed(made, folder / f"{scene}_{name.replace(' ', '_')}", change, given)
        unit = truth.length_unit
        rms = metrics.get(f"camera_rms_{unit}", math.inf)
        turned = metrics.get("camera_rotation_rms_deg", math.inf)
        print(
            f"{name:17} {metrics['registered_images']}/{metrics['images']} images, cameras {rms:.4f} {unit} "
            f"({100.0 * rms / extent:.4f} % of their extent), {turned:.4f} degrees, points "
            f"{metrics.get(f'point_rms_{unit}', math.inf):.4f} {unit}, {metrics['seconds_total']:.0f} s"
        )
        figure(f"{scene}/{name.replace(' ', '_')}/camera_rms", rms, unit, "lower")
        for key, value in metrics.items():
            if key.startswith(("dense_accuracy", "dense_surface", "dense_points")):
                print(f"{'':17} {key} {value:.4g}")
        for line in (*metrics.get("determined", ()), *(warning["message"] for warning in metrics["warnings"])):
            print(f"{'':17} {line}")


def _made(scene: str, folder: Path) -> Path:
    """The folder of the rendered scene."""
    found = [*folder.glob(f"cache/{scene}_*/capture.json")]
    if not found:
        command = (sys.executable, "-m", "torchrefrac", f"scene={scene}", f"cache={folder / 'cache'}", "-q")
        subprocess.run([*command, "features.max_features=100", "report=false", f"out={folder / 'made'}"], check=False)
        found = [*folder.glob(f"cache/{scene}_*/capture.json")]
    return found[0].parent


def _reconstructed(made: Path, run: Path, change: Callable[[Content], None], given: tuple[str, ...]) -> dict[str, Any]:
    """The metrics of a run by what is left of the capture."""
    capture = run.with_name(run.name + "_capture")
    capture.mkdir(exist_ok=True)
    content = json.loads((made / "capture.json").read_text())
    change(content)
    content["folder"] = str(made / "images")
    (capture / "capture.json").write_text(json.dumps(content))
    for name in ("truth.json", "truth_points.npz", "truth_surface.ply"):
        if (made / name).is_file() and not (capture / name).exists():
            (capture / name).symlink_to(made / name)
    scene = ("scene=capture", f"scene.path={capture}", f"out={run}", "report=false", "-q")
    subprocess.run([sys.executable, "-m", "torchrefrac", *scene, *given], check=True)
    return json.loads((run / "metrics.json").read_text())


if __name__ == "__main__":
    main()
