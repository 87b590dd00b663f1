"""From filled views to a dense cloud: seconds and memory for each patch, without the photometry that finds them.

    python tools/bench/fusing.py [--side 5] [--width 1000] [--method patch] [--folder FOLDER]

`--side` x `--side` photographs of a bed at a depth of 2 m, from 30 m above the water, with an overlap of a half each
way, each filled with patches that lie where it shows the bed. Peak memory is that of arrays alone: pages of files that
are mapped go whenever memory is short.
"""

import resource
import tempfile
import threading
import time
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import torch
from baseline import bench_parser, figure

from torchrefrac.camera import Intrinsics
from torchrefrac.dense import DenseOptions, FolderStore, densify
from torchrefrac.dense.patches import Patches
from torchrefrac.dense.rays import PixelRays
from torchrefrac.geometry import Rigid
from torchrefrac.recorder import SilentRecorder
from torchrefrac.scene import Cameras, Capture, Interfaces, Observations, Scene

ABOVE, BED, SPACING = 30.0, -2.0, 16.0
CELL = 2
DOWN = torch.tensor([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]], dtype=torch.float64)


def main() -> None:
    parser = bench_parser("From filled views to a dense cloud.")
    parser.add_argument("--side", type=int, default=5, help="photographs along each side of the field")
    parser.add_argument("--width", type=int, default=1000, help="pixels of a photograph")
    parser.add_argument("--method", default="patch", choices=("patch", "depthmap"))
    parser.add_argument("--folder", type=Path, help="where the photographs and finished views lie")
    options = parser.parse_args()
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as temporary:
        folder = options.folder or Path(temporary)
        scene = _scene(options.side, options.width, folder)
        dense = DenseOptions(method=options.method, cell=CELL)
        store = FolderStore(folder / "parts", scene, dense)
        patches = sum(_fill(scene, view, dense, store) for view in range(len(scene.views)))
        before = _anonymous()
        watch = _Watch()
        start, used = time.perf_counter(), time.process_time()
        cloud = densify(scene, dense, SilentRecorder(), store).cloud
        seconds, processor = time.perf_counter() - start, time.process_time() - used
        peak = watch.end() - before
    off = (cloud.points[:, 2] - BED).abs().max()
    print(f"{patches / 1e6:.2f} million patches of {len(scene.views)} views, {len(cloud) / 1e6:.2f} remain")
    print(f"{seconds:.0f} s, {1e6 * processor / patches:.1f} us of a processor and {peak / patches:.0f} bytes for each")
    print(f"most that was resident at any time: {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20:.2f} GiB")
    print(f"heights are off by {off:.1g} m at most")
    figure("memory for a patch", peak / patches, "byte", "lower", 0.2)
    figure("time for a patch", 1e6 * processor / patches, "us", "lower", 0.3)


def _scene(side: int, width: int, folder: Path) -> Scene:
    """Of side x side views of the bed, with tie points, and photographs of one colour."""
    intrinsics = Intrinsics.create(width, 3 * width // 4, float(width))
    x, y = torch.meshgrid(*(SPACING * torch.arange(side, dtype=torch.float64),) * 2, indexing="ij")
    center = torch.stack((x, 0.75 * y, torch.full_like(x, ABOVE)), dim=-1).reshape(-1, 3)
    names = tuple(f"{view:03d}.png" for view in range(len(center)))
    for name in names:
        cv2.imwrite(str(folder / name), np.full((3 * width // 4, width, 3), 90, dtype=np.uint8))
    ties = 2.0 * torch.cartesian_prod(*(torch.arange(-10.0, 8.0 * side + 10.0, dtype=torch.float64),) * 2)
    points = torch.cat((ties, torch.full_like(ties[:, :1], BED)), dim=-1)
    poses = Rigid(DOWN.expand(len(center), 3, 3).contiguous(), center)
    water = Interfaces.level(1.333)
    none = Observations.none()
    cameras = Scene.create(poses, intrinsics, water, points[:0], none, names=names, length_unit="m").camera_of()
    pixels, seen = cameras[:, None].project(points, inside_image=True)
    point, view = seen.T.nonzero(as_tuple=True)
    observations = Observations(view, point, pixels[view, point])
    scene = Scene.create(poses, intrinsics, water, points, observations, names=names, length_unit="m")
    count = len(center)
    capture = Capture(
        folder, names, tuple(folder / name for name in names), Cameras.of([intrinsics]), water,
        torch.tensor([[0.0, 0.0, 1.0]] * count, dtype=torch.float64),
        torch.full((count,), torch.inf, dtype=torch.float64), torch.ones(count, dtype=torch.float64),
        torch.zeros(count, dtype=torch.bool), "m",
    )  # fmt: skip
    return replace(scene, capture=capture)


def _fill(scene: Scene, view: int, options: DenseOptions, store: FolderStore) -> int:
    """A patch in every cell of a view, where it shows the bed, seen by the neighbours on its sides."""
    camera = scene.camera_of(view)
    intrinsics = camera.intrinsics
    rows, columns = torch.arange(intrinsics.height // CELL), torch.arange(intrinsics.width // CELL)
    pixels = CELL * (torch.cartesian_prod(columns, rows).double() + 0.5)
    rays, up = PixelRays.cast(camera, pixels), torch.tensor((0.0, 0.0, 1.0), dtype=torch.float64)
    points = rays.at(rays.meet((BED * up).expand(len(pixels), 3), up.expand(len(pixels), 3)))
    count = len(points)
    constant = torch.ones(count, dtype=torch.float64)
    apart = (scene.views.center - scene.views.center[view]).norm(dim=-1)
    others = apart.argsort()[1 : 1 + options.views].expand(count, -1)
    patches = Patches(
        torch.full((count,), view), pixels, points, up.expand(count, 3), 0.01 * constant,
        (points - camera.center_in_world).norm(dim=-1) / intrinsics.focal[0], 0.9 * constant, others,
        torch.ones_like(others, dtype=torch.bool),
    )  # fmt: skip
    store.save(view, patches.padded(options.views))
    return count


def _anonymous() -> int:
    """Bytes of this process that lie in no file."""
    lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    return 1024 * next(int(line.split()[1]) for line in lines if line.startswith("RssAnon"))


class _Watch:
    """Looks at this process's memory from time to time."""

    def __init__(self) -> None:
        self._most, self._ended = 0, threading.Event()
        self._thread = threading.Thread(target=self._look, daemon=True)
        self._thread.start()

    def _look(self) -> None:
        while not self._ended.wait(0.02):
            self._most = max(self._most, _anonymous())

    def end(self) -> int:
        """The most bytes that there were."""
        self._ended.set()
        self._thread.join()
        return self._most


if __name__ == "__main__":
    main()
