"""A radiance field under water: what refraction is worth to it.

    python examples/radiance_field.py [--steps 400] [--out outputs/radiance_field]

The embedded tank is reconstructed twice from its eight photographs, with refraction and without. Then the same field of
colour and density is learnt from the rays of seven of them (`tr.RefractiveRays`), and the eighth is predicted: with all
that the first run has found; with what the second has, which knows no water; and with the water, but with the poses of
the second. The table has the colours' peak signal-to-noise ratio in the predicted photograph, and how far
the points that its pixels see are from the true ones in height; the picture shows both.

The field is K-planes' product of three feature planes (Fridovich-Keil et al., CVPR 2023) at two resolutions, with a
small network behind; samples along rays are drawn where the field has become dense. Rays of keypoints are to end at the
points that the run has found (Deng et al., CVPR 2022).
"""

import argparse
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import matplotlib.pyplot as plt
import torch
from torch import Tensor, nn
from torch.nn import functional
from tqdm import tqdm

import torchrefrac as tr
from torchrefrac.files.library import embedded_scene

SMALLER = 2  # photographs of 320 x 240 pixels
RAYS, KEYPOINTS, COARSE, FINE = 2048, 512, 48, 24
RESOLUTIONS, FEATURES, HIDDEN = (64, 256), 12, 32
GRID = 64  # cells along each axis of the copy of the density that samples are drawn by


class Result(NamedTuple):
    """Of the photograph that was not learnt from."""

    image: Tensor
    height_error: Tensor
    psnr: float
    height_rms: float


def main() -> None:
    parser = argparse.ArgumentParser(description="What refraction is worth to a radiance field.")
    parser.add_argument("--steps", type=int, default=400)
    parser.add_argument("--out", type=Path, default=Path("outputs/radiance_field"))
    arguments = parser.parse_args()
    folder = embedded_scene("tank_small")
    runs = {model: reconstructed(folder, model, arguments.out / model) for model in ("refractive", "none")}
    cases = {
        "with refraction": (runs["refractive"], None),
        "without": (runs["none"], None),
        "wrong poses": (runs["refractive"], runs["none"]),
    }
    results = {name: learnt(folder, *given, arguments.steps, name) for name, given in cases.items()}
    print(f"{'':<18}{'PSNR':>8}{'heights':>12}")
    for name, result in results.items():
        print(f"{name:<18}{result.psnr:>5.1f} dB{result.height_rms:>9.2f} cm")
    draw(results, arguments.out / "radiance_field.png")


def reconstructed(folder: Path, model: str, run: Path) -> Path:
    """The folder of a run, which is made unless it is there."""
    if not (run / "cameras.json").is_file():
        options = f"scene.path={folder}", f"model={model}", f"out={run}", "report=false", "quiet=true"
        subprocess.run([sys.executable, "-m", "torchrefrac", "scene=capture", *options], check=True)
    return run


def learnt(folder: Path, run: Path, poses: Path | None, steps: int, name: str) -> Result:
    """Learn a field from the rays of a run, as if its cameras stood where another run has them, and judge it."""
    torch.manual_seed(0)
    data, held_out = (tr.RefractiveRays(run, split, smaller=SMALLER) for split in ("train", "test"))
    scene, truth = tr.read_scene(run), tr.load_truth(folder)
    alignment = tr.evaluate(scene, truth)[1]
    if poses is not None:
        data, held_out = (moved(rays, poses, folder, alignment) for rays in (data, held_out))
    low, high = scene.points.quantile(0.005, dim=0).float(), scene.points.quantile(0.995, dim=0).float()
    margin = 0.1 * (high - low)
    field = Field(low - margin, high + margin)
    train(field, data, Keypoints.of(scene, data), steps, name)
    return judged(field, held_out, folder, truth, alignment)


def moved(rays: tr.RefractiveRays, run: Path, folder: Path, alignment) -> tr.RefractiveRays:
    """The same rays from where another run has the cameras, both runs aligned with the truth."""
    other = tr.read_scene(run)
    onto_truth, back = tr.evaluate(other, tr.load_truth(folder))[1], alignment.inverse()
    rows = [other.views.names.index(name) for name in rays.names]
    rotation, center = other.views.rotation[rows], other.views.center[rows]
    camera = rays.cameras
    placed = tr.RefractiveCamera(
        camera.intrinsics,
        back.apply_to_rotation(onto_truth.apply_to_rotation(rotation)),
        back.apply(onto_truth.apply(center)),
        camera.interface,
    )
    return rays.with_cameras(placed)


class Keypoints(NamedTuple):
    """Rays of what the run has found of its points, and how far behind the refrax these are."""

    rays: tr.Rays
    distance: Tensor

    @classmethod
    def of(cls, scene: tr.Scene, data: tr.RefractiveRays) -> "Keypoints":
        seen = scene.observations[scene.accepted]
        row = torch.tensor([data.names.index(name) if name in data.names else -1 for name in scene.views.names])
        seen = seen[row[seen.view] >= 0]
        view, points = row[seen.view], scene.points[seen.point]
        camera = data.cameras[view]
        refrax, _, direction, bent = camera.follow_rays(seen.pixels)
        distance = ((points - refrax) * direction).sum(dim=-1).float()
        none = torch.zeros(len(view), 3)
        rays = tr.Rays(
            camera.center_in_world.float(), refrax.float(), direction.float(), none, bent, view, seen.pixels.float()
        )
        return cls(rays, distance)

    def some(self, count: int) -> tuple[tr.Rays, Tensor]:
        rows = torch.randint(len(self.distance), (count,))
        return tr.Rays(*(part[rows] for part in self.rays)), self.distance[rows]


class Field(nn.Module):
    """Colour and density inside a box."""

    def __init__(self, low: Tensor, high: Tensor) -> None:
        super().__init__()
        self.register_buffer("low", low)
        self.register_buffer("size", high - low)
        self.planes = nn.ParameterList(
            nn.Parameter(torch.rand(3, FEATURES, cells, cells) * 0.4 + 0.8) for cells in RESOLUTIONS
        )
        self.network = nn.Sequential(
            nn.Linear(len(RESOLUTIONS) * FEATURES, HIDDEN), nn.ReLU(), nn.Linear(HIDDEN, HIDDEN), nn.ReLU(),
            nn.Linear(HIDDEN, 4),
        )  # fmt: skip
        self.register_buffer("dense", torch.ones(1, 1, GRID, GRID, GRID))

    def forward(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Colours (..., 3) and densities (...), per unit of length, of points (..., 3)."""
        place = 2.0 * (points - self.low) / self.size - 1.0
        flat = place.reshape(-1, 3)
        across = torch.stack((flat[:, [0, 1]], flat[:, [0, 2]], flat[:, [1, 2]]))[:, :, None]
        features = [
            functional.grid_sample(plane, across, align_corners=True, padding_mode="border")[..., 0].prod(dim=0)
            for plane in self.planes
        ]
        found = self.network(torch.cat(features).T).view(*points.shape[:-1], 4)
        inside = (place.abs() <= 1.0).all(dim=-1)
        density = functional.softplus(found[..., 3] - 1.0) * 10.0 / self.size.mean()
        return found[..., :3].sigmoid(), torch.where(inside, density, 0.0)

    @torch.no_grad()
    def look_at_density(self) -> None:
        """Copy it into the grid that samples are drawn by."""
        steps = torch.linspace(0.0, 1.0, GRID)
        z, y, x = torch.meshgrid(steps, steps, steps, indexing="ij")
        points = self.low + self.size * torch.stack((x, y, z), dim=-1)
        density = torch.stack([self(layer)[1] for layer in points])
        self.dense = functional.max_pool3d(density[None, None], 3, 1, 1)

    @torch.no_grad()
    def sampled(self, rays: tr.Rays, jitter: bool) -> tuple[Tensor, Tensor]:
        """Distances from the refrax (n, FINE) where the box is dense, and how long each stands for."""
        near, far = crossed(rays.refrax, rays.direction, self.low, self.low + self.size)
        share = (torch.arange(COARSE) + 0.5) / COARSE
        coarse = near[:, None] + (far - near)[:, None] * share
        place = 2.0 * (rays.at(coarse) - self.low) / self.size - 1.0
        density = functional.grid_sample(self.dense, place[None, :, :, None], align_corners=True)[0, 0, ..., 0]
        length = (far - near)[:, None] / COARSE
        clear = torch.exp(-torch.cumsum(density * length, dim=1))
        ahead = torch.cat((torch.ones_like(clear[:, :1]), clear[:, :-1]), dim=1)
        weight = ahead - clear + 0.02 / COARSE
        upto = torch.cumsum(weight / weight.sum(dim=1, keepdim=True), dim=1)
        middle = (torch.arange(FINE) + (torch.rand(len(near), FINE) if jitter else 0.5)) / FINE
        cell = torch.searchsorted(upto, middle.expand(len(near), -1).contiguous()).clamp(max=COARSE - 1)
        before = torch.where(cell > 0, upto.gather(1, (cell - 1).clamp(min=0)), 0.0)
        inside = ((middle - before) / (upto.gather(1, cell) - before).clamp(min=1e-9)).clamp(0.0, 1.0)
        distance = near[:, None] + (cell + inside) * length
        edges = torch.cat((near[:, None], 0.5 * (distance[:, 1:] + distance[:, :-1]), far[:, None]), dim=1)
        return distance, edges.diff(dim=1).clamp(min=0.0)


def crossed(origin: Tensor, direction: Tensor, low: Tensor, high: Tensor) -> tuple[Tensor, Tensor]:
    """Where rays enter a box and leave it; nowhere behind their origins."""
    first, second = (low - origin) / direction, (high - origin) / direction
    near = torch.minimum(first, second).amax(dim=-1).clamp(min=0.0)
    return near, torch.maximum(torch.maximum(first, second).amin(dim=-1), near + 1e-6)


def rendered(field: Field, rays: tr.Rays, jitter: bool) -> tuple[Tensor, Tensor]:
    """Colours (n, 3) and distances from the refrax (n) at which the field stops rays."""
    distance, length = field.sampled(rays, jitter)
    color, density = field(rays.at(distance))
    clear = torch.exp(-torch.cumsum(density * length, dim=1))
    weight = torch.cat((torch.ones_like(clear[:, :1]), clear[:, :-1]), dim=1) - clear
    whole = weight.sum(dim=1).clamp(min=1e-6)
    rest = (1.0 - whole)[:, None] * color[:, -1]
    return (weight[..., None] * color).sum(dim=1) + rest, (weight * distance).sum(dim=1) / whole


def train(field: Field, data: tr.RefractiveRays, keypoints: Keypoints, steps: int, name: str) -> None:
    optimizer = torch.optim.Adam(
        [{"params": list(field.planes), "lr": 0.03}, {"params": list(field.network.parameters()), "lr": 0.005}]
    )
    schedule = torch.optim.lr_scheduler.ExponentialLR(optimizer, gamma=0.1 ** (1.0 / steps))
    batches = iter(data.loader(RAYS, seed=0))
    progress = tqdm(range(steps), desc=name, unit="step")
    for step in progress:
        try:
            rays = next(batches)
        except StopIteration:
            batches = iter(data.loader(RAYS, seed=step))
            rays = next(batches)
        if step % 25 == 10:
            field.look_at_density()
        color, _ = rendered(field, rays, jitter=True)
        loss = (color - rays.color)[rays.mask].square().mean()
        known, distance = keypoints.some(KEYPOINTS)
        near = (rendered(field, known, jitter=True)[1] - distance).abs().mean() / field.size.mean()
        optimizer.zero_grad()
        (loss + 0.3 * near + 2e-4 * roughness(field)).backward()
        optimizer.step()
        schedule.step()
        if step % 10 == 0:
            progress.set_postfix_str(f"{-10.0 * float(loss.detach().log10()):.1f} dB")
    field.look_at_density()


def roughness(field: Field) -> Tensor:
    """How much neighbours differ in the planes."""
    total = torch.zeros(())
    for plane in field.planes:
        total = total + plane.diff(dim=2).square().mean() + plane.diff(dim=3).square().mean()
    return total


@torch.no_grad()
def judged(field: Field, held_out: tr.RefractiveRays, folder: Path, truth: tr.Truth, alignment) -> Result:
    """Predict the photograph that was not learnt from; heights are those above the water, after the alignment."""
    whole = held_out.image(0)
    height, width = whole.mask.shape
    flat = tr.Rays(*(part.flatten(0, 1) for part in whole))
    parts = [tr.Rays(*(part[i : i + 8192] for part in flat)) for i in range(0, len(flat.mask), 8192)]
    colors, distances = (
        torch.cat(part) for part in zip(*(rendered(field, rays, False) for rays in parts), strict=True)
    )
    points = alignment.apply(flat.at(distances[:, None])[:, 0].double())
    true, seen = true_points(folder, truth, held_out.names[0], flat.pixel.double())
    near, far = crossed(flat.refrax, flat.direction, field.low, field.low + field.size)
    seen = seen & (far > near + 1e-5)  # the field knows nothing beside its box
    error = (points[:, 2] - true[:, 2]).where(seen, torch.nan)
    used = flat.mask
    psnr = -10.0 * float((colors - flat.color)[used].square().mean().log10())
    return Result(
        colors.view(height, width, 3),
        error.view(height, width),
        psnr,
        float(error[seen & used].square().mean().sqrt()),
    )


def true_points(folder: Path, truth: tr.Truth, name: str, pixels: Tensor) -> tuple[Tensor, Tensor]:
    """What pixels see of the boards in the tank, and whether they see any."""
    from learn_water import first_hit, load  # noqa: PLC0415 - the example beside this one

    _, cameras, boards, _ = load()
    row = truth.names.index(name)
    origins, directions, valid = cameras[row].cast_rays(pixels)
    points, hit = first_hit(origins, directions, boards)
    return points, hit & valid


def draw(results: dict[str, Result], path: Path) -> None:
    """Predicted photographs, and errors of height."""
    figure, axes = plt.subplots(2, len(results), figsize=(4.2 * len(results), 6.4), layout="constrained")
    for column, (name, result) in zip(axes.T, results.items(), strict=True):
        column[0].imshow(result.image.clamp(0.0, 1.0).numpy())
        column[0].set_title(f"{name}: {result.psnr:.1f} dB")
        shown = column[1].imshow(result.height_error.numpy(), cmap="RdBu", vmin=-10.0, vmax=10.0)
        column[1].set_title(f"heights: {result.height_rms:.2f} cm RMS")
        for axis in column:
            axis.set_axis_off()
    figure.colorbar(shown, ax=axes[1], label="height above the true surface, cm", shrink=0.9)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=120)
    print(f"written to {path}")


if __name__ == "__main__":
    main()
