"""A radiance field under water: what refraction is worth to it.

    python examples/radiance_field.py [--steps 1000] [--out outputs/radiance_field]

The embedded tank is reconstructed twice from its eight photographs, with refraction and without. Then a field of colour
and density learns from the rays of seven of them (`tr.RefractiveRays`, 320 x 240) and predicts the eighth: with all
that the first run has found; with what the second has, which knows no water; and with the water, but with the poses of
the second. The table says how well the colours of the eighth photograph are predicted (peak signal-to-noise ratio),
and how far the points that its pixels see are from the true ones in height; both where it truly sees the ground or a
board.

What lies under water here is opaque. So the density is that of a soft step across a height, which is known at the nodes
of a grid and begins at the points that the run has found; colours are a sum of grids from coarse to fine. A height has
no overhang: where the edge of a board stands above the ground, the field has a wall that is not there, which counts in
all root mean squares, but hardly in medians.
"""

import argparse
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import matplotlib.pyplot as plt
import torch
from learn_water import first_hit, load
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from torch import Tensor, nn
from torch.nn import functional
from tqdm import tqdm

import torchrefrac as tr
from torchrefrac.geometry.alignment import Similarity

HELD_OUT = ["cam03.jpg"]
HALF = 160.0  # of the side of the field, cm: of a tank of 200 cm, and what straight rays make of it
HEIGHTS, COLORS = 200, (64, 128, 256, 512)  # nodes along each side
COARSE, FINE = 96, 14  # samples of a ray: to find the surface, and across it
FIRST_WIDTH, LAST_WIDTH = 2.0, 0.3  # of the step, cm
RAYS = 4096  # of each step of Adam


class Lines(NamedTuple):
    """Rays from the refrax on, or from the camera where there is no water: origins, unit vectors, colours, (n, 3)."""

    origin: Tensor
    direction: Tensor
    color: Tensor


class Case(NamedTuple):
    """What a field is learnt with and judged by, all in the frame of the truth, float32."""

    points: Tensor
    train: Lines
    test: Lines


class Result(NamedTuple):
    """Predicted photograph (h, w, 3), errors of its heights (h, w), cm, NaN where it sees no board, and PSNR, dB."""

    image: Tensor
    error: Tensor
    psnr: float


def main() -> None:
    parser = argparse.ArgumentParser(description="What refraction is worth to a radiance field.")
    parser.add_argument("--steps", type=int, default=1000, help="steps of Adam for each field")
    parser.add_argument("--out", type=Path, default=Path("outputs/radiance_field"), help="where runs and picture go")
    arguments = parser.parse_args()
    right, straight = (reconstructed(model, arguments.out / model) for model in ("refractive", "none"))
    true_points, seen, true_image = truth_of_held_out(right)
    results = {}
    for name, run, poses in (
        ("with refraction", right, right),
        ("without", straight, straight),
        ("with, poses of without", right, straight),
    ):
        case = case_of(run, poses)
        field = Field(case.points)
        train(field, case.train, arguments.steps, name)
        results[name] = judged(field, case.test, true_points, seen, true_image)
    report(results)
    draw(results, true_image, arguments.out / "radiance_field.jpg")


def reconstructed(model: str, run: Path) -> Path:
    """The folder of a run, which is made unless it is there."""
    if not (run / "metrics.json").is_file():
        options = "scene=tank_small", f"model={model}", f"out={run}", "report=false", "quiet=true"
        subprocess.run([sys.executable, "-m", "torchrefrac", *options], check=True)
    return run


def case_of(run: Path, poses: Path) -> Case:
    """The rays of a run, as if its cameras stood where another run has them, which is aligned with the truth."""
    scene = tr.read_scene(poses)
    _, alignment = tr.evaluate(scene, true_scene())
    assert alignment is not None
    points = alignment.apply(scene.points[scene.points.isfinite().all(dim=1)])
    train, test = (
        lines(tr.RefractiveRays(run, split, holdout=HELD_OUT, smaller=2), scene, alignment)
        for split in ("train", "test")
    )
    return Case(points.float(), train, test)


def lines(rays: tr.RefractiveRays, scene: tr.Scene, alignment: Similarity) -> Lines:
    """All rays of photographs whose cameras stand where the scene has them, in the frame of the truth."""
    rows = [scene.views.names.index(name) for name in rays.names]
    given = rays.cameras
    cameras = tr.RefractiveCamera(
        given.intrinsics,
        alignment.apply_to_rotation(scene.views.rotation[rows]),
        alignment.apply(scene.views.center[rows]),
        given.interface,
    )
    parts: list[Lines] = []
    for view in range(len(rays.names)):
        image = rays.image(view)
        used = image.mask
        origin, direction, _ = cameras[view].cast_rays(image.pixel[used].double())
        parts.append(Lines(origin.float(), direction.float(), image.color[used]))
    return Lines(*(torch.cat(part) for part in zip(*parts, strict=True)))


class Field(nn.Module):
    """Heights and colours above the ground."""

    def __init__(self, points: Tensor) -> None:
        """Heights begin as medians of the nearest points (n, 3); colours as grey."""
        super().__init__()
        axis = torch.linspace(-HALF, HALF, HEIGHTS)
        nodes = torch.stack(torch.meshgrid(axis, axis, indexing="xy"), dim=-1).view(-1, 2)
        near = torch.cdist(nodes, points[:, :2]).topk(7, largest=False).indices
        height = points[near, 2].median(dim=1).values
        self.height = nn.Parameter(height.view(1, 1, HEIGHTS, HEIGHTS))
        self.colors = nn.ParameterList(nn.Parameter(torch.zeros(1, 3, size, size)) for size in COLORS)
        self.bottom, self.top = float(points[:, 2].quantile(0.01)) - 6.0, float(points[:, 2].quantile(0.99)) + 6.0

    def above(self, points: Tensor) -> Tensor:
        """How far points (n, s, 3) are above the surface, along the vertical."""
        return points[..., 2] - _looked_up(self.height, points)[..., 0]

    def color(self, points: Tensor) -> Tensor:
        return 0.5 + torch.stack([_looked_up(grid, points) for grid in self.colors]).sum(dim=0)

    def rendered(self, rays: Lines, width: float) -> tuple[Tensor, Tensor]:
        """Colours (n, 3) of rays, and the points (n, 3) at which they end, across a step of this width."""
        middle = self.first_crossing(rays)[:, None]
        offset = torch.linspace(-3.0, 3.0, FINE)
        jitter = torch.rand(len(middle), FINE) - 0.5 if self.training else torch.zeros(1)
        distance = middle + width * (offset + jitter * (offset[1] - offset[0]))
        points = rays.origin[:, None] + distance[..., None] * rays.direction[:, None]
        left = torch.sigmoid(self.above(points) / (0.35 * width)).cummin(dim=1).values  # of the light behind a sample
        left = torch.cat((torch.ones_like(left[:, :1]), left[:, :-1], torch.zeros_like(left[:, :1])), dim=1)
        weight = (left[:, :-1] - left[:, 1:])[..., None]
        return (weight * self.color(points)).sum(dim=1), (weight * points).sum(dim=1)

    @torch.no_grad()
    def first_crossing(self, rays: Lines) -> Tensor:
        """Distance (n) at which rays first go below the surface, or leave what is known of it."""
        level = torch.linspace(self.top, self.bottom, COARSE)
        distance = (level - rays.origin[:, 2:]) / rays.direction[:, 2:]
        above = self.above(rays.origin[:, None] + distance[..., None] * rays.direction[:, None])
        below = torch.cat((above[:, :-1] < 0.0, torch.ones_like(above[:, :1], dtype=torch.bool)), dim=1)
        after = below.float().argmax(dim=1, keepdim=True).clamp(min=1)
        before, beyond = above.gather(1, after - 1), above.gather(1, after)
        share = (before / (before - beyond).clamp(min=1e-6)).clamp(0.0, 1.0)
        return torch.lerp(distance.gather(1, after - 1), distance.gather(1, after), share)[:, 0]


def train(field: Field, rays: Lines, steps: int, name: str) -> None:
    torch.manual_seed(0)
    optimizer = torch.optim.Adam(
        [{"params": [field.height], "lr": 0.15}, {"params": list(field.colors), "lr": 0.03}], betas=(0.9, 0.99)
    )
    schedule = torch.optim.lr_scheduler.ExponentialLR(optimizer, gamma=0.05 ** (1.0 / steps))
    for step in tqdm(range(steps), desc=name, unit="step", leave=False):
        rows = torch.randint(len(rays.origin), (RAYS,))
        some = Lines(*(part[rows] for part in rays))
        color, _ = field.rendered(some, FIRST_WIDTH * (LAST_WIDTH / FIRST_WIDTH) ** (step / steps))
        rough = torch.stack([_roughness(grid) for grid in (field.height, *field.colors)]).sum()
        optimizer.zero_grad()
        ((color - some.color).abs().mean() + 3e-4 * rough).backward()
        optimizer.step()
        schedule.step()


@torch.no_grad()
def judged(field: Field, rays: Lines, true_points: Tensor, seen: Tensor, true_image: Tensor) -> Result:
    """Predict the photograph that was not learnt from."""
    field.eval()
    parts = [field.rendered(Lines(*part), LAST_WIDTH) for part in zip(*(p.split(8192) for p in rays), strict=True)]
    image, points = (torch.cat(part).view(true_image.shape) for part in zip(*parts, strict=True))
    error = torch.where(seen, points[..., 2] - true_points[..., 2], torch.nan)
    psnr = -10.0 * (image - true_image)[seen].square().mean().log10()
    return Result(image.clamp(0.0, 1.0), error, float(psnr))


def truth_of_held_out(run: Path) -> tuple[Tensor, Tensor, Tensor]:
    """What its pixels see of the boards in the tank (h, w, 3), whether they see any (h, w), and its colours."""
    image = tr.RefractiveRays(run, "test", holdout=HELD_OUT, smaller=2).image(0)
    _, cameras, boards, _ = load()
    row = true_scene().names.index(HELD_OUT[0])
    origins, directions, valid = cameras[row].cast_rays(image.pixel.double())
    points, hit = first_hit(origins, directions, boards)
    return points.float(), hit & valid, image.color


def true_scene() -> tr.Truth:
    truth = tr.load_truth(tr.embedded_scene("tank_small"))
    assert truth is not None
    return truth


def report(results: dict[str, Result]) -> None:
    print(f"{'held-out photograph':<24}{'PSNR':>8}{'median of heights':>20}{'RMS':>12}")
    for name, result in results.items():
        error = result.error[result.error.isfinite()]
        median, rms = float(error.abs().median()), float(error.square().mean().sqrt())
        print(f"{name:<24}{result.psnr:5.1f} dB{median:17.2f} cm{rms:9.2f} cm")


def draw(results: dict[str, Result], true_image: Tensor, path: Path) -> None:
    """Predicted photographs beside the true one, and errors of height."""
    scale = Normalize(-15.0, 15.0)
    figure, axes = plt.subplots(2, 4, figsize=(11.0, 4.6), layout="constrained")
    axes[0, 0].imshow(true_image.numpy())
    axes[0, 0].set_title("the held-out photograph", fontsize=9)
    for (name, result), (top, bottom) in zip(results.items(), axes.T[1:], strict=True):
        top.imshow(result.image.numpy())
        top.set_title(f"{name}: {result.psnr:.1f} dB", fontsize=9)
        bottom.imshow(result.error.numpy(), norm=scale, cmap="RdBu")
    for axis in axes.flat:
        axis.set_axis_off()
    figure.colorbar(
        ScalarMappable(scale, "RdBu"), ax=axes[1, 0], label="height above the true one, cm", location="left", shrink=0.9
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=90, pil_kwargs={"quality": 85})


def _looked_up(grid: Tensor, points: Tensor) -> Tensor:
    """Values (*n, c) of a grid (1, c, h, w) at points (*n, 3) seen from above."""
    place = (points[..., :2] / HALF).view(1, 1, -1, 2)
    found = functional.grid_sample(grid, place, align_corners=True, padding_mode="border")
    return found[0, :, 0].T.view(*points.shape[:-1], -1)


def _roughness(grid: Tensor) -> Tensor:
    return grid.diff(dim=2).abs().mean() + grid.diff(dim=3).abs().mean()


if __name__ == "__main__":
    main()
