"""Gaussians seen through water: a splatting renderer in plain PyTorch, with refraction and without.

    python examples/gaussians.py [--steps 120] [--count 5000] [--out outputs/gaussians]

The embedded tank is reconstructed twice, with its water and as if there were none. The dense points of each become
Gaussians, flat discs on the surface, which are trained on seven of the eight photographs. A splatting renderer needs of
a camera no more than where a Gaussian appears and how its covariance is projected there: `project_with_jacobians` gives
both through any interface, in closed form.

The eighth photograph, which no Gaussian has seen, says how well a view is predicted: about as well in both. A scene
without water bends until it looks right from everywhere near the photographs; only the truth says that it is more than
ten centimetres off. What is trained through water but drawn as if in air does not even look right.
"""

import argparse
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import cv2
import torch
from torch import Tensor, nn
from tqdm import tqdm

import torchrefrac as tr
from torchrefrac.config import ModelOptions
from torchrefrac.evaluate.metrics import evaluate
from torchrefrac.evaluate.true_surface import TrueSurface
from torchrefrac.files.library import embedded_scene
from torchrefrac.files.photographs import read_color

Model = Literal["refractive", "none"]
UNSEEN = 3  # the photograph that is left out
SMALLER = 4  # times that photographs are worked on
TILE = 8  # pixels across of what is drawn at once
SOFT = 0.3  # pixels squared, by which every Gaussian is wider than it is: a pixel's own size
BRIGHT = 1.0 / 255.0
HALF, COVERED = 0.5, 0.9  # of a pixel, from which on it is trained on, and is judged


def main() -> None:
    parser = argparse.ArgumentParser(description="Gaussians seen through water.")
    parser.add_argument("--steps", type=int, default=120, help="photographs that are trained on, one after the other")
    parser.add_argument("--count", type=int, default=5000, help="Gaussians")
    parser.add_argument("--out", type=Path, default=Path("outputs/gaussians"), help="folder of a picture")
    arguments = parser.parse_args()
    capture = tr.load_capture(embedded_scene("tank_small"))
    photographs = load_photographs(capture)
    pictures = [photographs[UNSEEN]]
    print(f"{'':<32}{'unseen view':>12}{'covered':>9}{'off the surface':>17}{'within 0.2 cm':>15}")
    models: tuple[Model, ...] = ("refractive", "none")
    for name in models:
        scene, cloud = reconstruct(capture, name)
        model, cameras = Gaussians.on_surface(cloud, arguments.count), smaller(scene.camera_of())
        train(model, cameras, photographs, arguments.steps)
        off = off_surface(model, scene)
        found = f"{float(off.square().mean().sqrt()):>14.2f} cm{100.0 * float((off < 0.2).double().mean()):>13.0f} %"
        if name == "refractive":
            pictures.append(draw("through water", model, cameras[UNSEEN], photographs[UNSEEN], found))
            pictures.append(draw("the same, drawn as if in air", model, cameras[UNSEEN].as_pinhole(), pictures[0], ""))
        else:
            pictures.append(draw("reconstructed as if in air", model, cameras[UNSEEN], photographs[UNSEEN], found))
    strip = torch.cat(pictures, dim=1).clamp(0.0, 1.0).repeat_interleave(2, dim=0).repeat_interleave(2, dim=1)
    arguments.out.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(arguments.out / "gaussians.png"), (255.0 * strip).round().byte().numpy())
    print("In the picture: the unseen photograph, and the three in this order.")


def draw(label: str, model: "Gaussians", camera: tr.RefractiveCamera, photograph: Tensor, found: str) -> Tensor:
    """The picture that a camera takes, after a line on how like the photograph it is where it is covered."""
    with torch.no_grad():
        picture, cover = model(camera)
    error = (picture - photograph)[cover > COVERED]
    psnr, covered = float(-10.0 * error.square().mean().log10()), float((cover > COVERED).double().mean())
    print(f"{label:<32}{psnr:>9.1f} dB{100.0 * covered:>7.0f} %{found}")
    return picture


@dataclass(frozen=True)
class Splats:
    """Gaussians as an image shows them, near ones first: at (n, 2) pixels, inverse covariance (n, 2, 2), radius (n)
    beyond which they are darker than a grey level, colour (n, 3) and opacity (n)."""

    at: Tensor
    inverse: Tensor
    radius: Tensor
    color: Tensor
    opacity: Tensor


class Gaussians(nn.Module):
    """n Gaussians: centre, axes as a rotation matrix that stays, logarithms of their lengths, colour and opacity."""

    axes: Tensor

    def __init__(self, center: Tensor, axes: Tensor, lengths: Tensor, color: Tensor) -> None:
        super().__init__()
        self.center = nn.Parameter(center)
        self.register_buffer("axes", axes)
        self.log_lengths = nn.Parameter(lengths.log())
        self.color = nn.Parameter(color)
        self.hidden = nn.Parameter(torch.full_like(lengths[:, 0], 2.0))

    @classmethod
    def on_surface(cls, cloud: tr.DenseCloud, count: int) -> "Gaussians":
        """Discs of dense points, as large as so many have to be to cover the surface."""
        rows = torch.randperm(len(cloud), generator=torch.Generator().manual_seed(0))[:count]
        some = cloud[rows]
        normal = some.normals.float()
        aside = torch.eye(3)[normal.abs().argmin(dim=1)]
        first = nn.functional.normalize(torch.linalg.cross(normal, aside), dim=1)
        axes = torch.stack((first, torch.linalg.cross(normal, first), normal), dim=2)
        points = some.points.float()
        apart = torch.cdist(points, points).topk(4, largest=False).values[:, 1:].mean(dim=1)
        lengths = apart[:, None] * torch.tensor([0.7, 0.7, 0.1])
        return cls(points, axes, lengths, some.colors.flip(-1).float() / 255.0)

    def splats(self, camera: tr.RefractiveCamera) -> Splats:
        """Where they appear, and how large, through whatever the camera looks through."""
        with torch.no_grad():
            _, by, seen = camera.project_with_jacobians(self.center.double())
        pixels, _ = camera.project(self.center.double())
        spread = (by.point.float() @ self.axes) * self.log_lengths.exp()[:, None]
        covariance = spread @ spread.mT + SOFT * torch.eye(2)
        opacity = torch.sigmoid(self.hidden)
        widest = covariance.detach().diagonal(dim1=1, dim2=2).amax(dim=1)
        radius = (2.0 * (opacity.detach() / BRIGHT).clamp(min=1.0).log() * widest).sqrt()
        depth = (self.center.detach() - camera.center_in_world.float()).norm(dim=1)
        order = torch.where(seen, depth, torch.inf).argsort()[: int(seen.sum())]
        inverse = torch.linalg.inv(covariance)
        return Splats(pixels.float()[order], inverse[order], radius[order], self.color[order], opacity[order])

    def forward(self, camera: tr.RefractiveCamera) -> tuple[Tensor, Tensor]:
        """The picture (height, width, 3) that a camera takes of them, and how much of each pixel they cover."""
        splats, width, height = self.splats(camera), camera.intrinsics.width, camera.intrinsics.height
        across, down = -(-width // TILE), -(-height // TILE)
        corner = TILE * torch.cartesian_prod(torch.arange(down), torch.arange(across)).flip(1).float()
        nearest = splats.at.detach()[None].clamp(corner[:, None], corner[:, None] + TILE)
        met = (nearest - splats.at.detach()).norm(dim=-1) < splats.radius
        number = torch.where(met, torch.arange(len(splats.at)), len(splats.at)).sort(dim=1).values
        number = number[:, : int(met.sum(dim=1).max())]
        real, number = number < len(splats.at), number.clamp(max=len(splats.at) - 1)
        inside = torch.cartesian_prod(torch.arange(TILE), torch.arange(TILE)).flip(1) + 0.5
        off = (corner[:, None] + inside)[:, None] - splats.at[number][:, :, None]
        form = splats.inverse[number][:, :, None]
        power = off[..., 0].square() * form[..., 0, 0] + off[..., 1].square() * form[..., 1, 1]
        power = power + 2.0 * off[..., 0] * off[..., 1] * form[..., 0, 1]
        alpha = (splats.opacity[number] * real)[..., None] * torch.exp(-0.5 * power)
        alpha = torch.where(alpha > BRIGHT, alpha, 0.0).clamp(max=0.99)
        passed = torch.cumprod(1.0 - alpha, dim=1)
        share = alpha * torch.cat((torch.ones_like(passed[:, :1]), passed[:, :-1]), dim=1)
        colors = torch.cat((splats.color, torch.ones_like(splats.opacity)[:, None]), dim=1)
        tiles = torch.einsum("tkp,tkc->tpc", share, colors[number]).view(down, across, TILE, TILE, 4)
        picture = tiles.permute(0, 2, 1, 3, 4).reshape(down * TILE, across * TILE, 4)[:height, :width]
        return picture[..., :3], picture[..., 3]


def train(model: Gaussians, cameras: tr.RefractiveCamera, photographs: Tensor, steps: int) -> None:
    """By the mean absolute difference of colours, on all photographs but the one that is left out."""
    rates = {"center": 0.002, "log_lengths": 0.01, "color": 0.01, "hidden": 0.05}
    optimizer = torch.optim.Adam([{"params": [getattr(model, name)], "lr": rate} for name, rate in rates.items()])
    seen = [view for view in range(len(photographs)) if view != UNSEEN]
    for step in tqdm(range(steps), unit="step", leave=False):
        view = seen[step % len(seen)]
        optimizer.zero_grad()
        picture, cover = model(cameras[view])
        (picture - photographs[view])[cover > HALF].abs().mean().backward()
        optimizer.step()


def off_surface(model: Gaussians, scene: tr.Scene) -> Tensor:
    """Distances of the Gaussians' centres from the true surface, in cm, in the frame of the truth."""
    truth = tr.load_truth(embedded_scene("tank_small"))
    assert truth is not None
    alignment = evaluate(scene, truth)[1]
    assert alignment is not None
    return TrueSurface(truth).distance(alignment.apply(model.center.detach().double()))


def reconstruct(capture: tr.Capture, model: Model) -> tuple[tr.Scene, tr.DenseCloud]:
    scene = tr.reconstruct(capture, tr.Options(model=ModelOptions(name=model)))
    return scene, tr.densify(scene).cloud


def load_photographs(capture: tr.Capture) -> Tensor:
    pictures = torch.stack([torch.from_numpy(read_color(path)) for path in capture.paths]).permute(0, 3, 1, 2)
    return nn.functional.avg_pool2d(pictures.float() / 255.0, SMALLER).permute(0, 2, 3, 1)


def smaller(cameras: tr.RefractiveCamera) -> tr.RefractiveCamera:
    """Of photographs SMALLER times smaller."""
    intrinsics = cameras.intrinsics
    small = replace(
        intrinsics,
        width=intrinsics.width // SMALLER,
        height=intrinsics.height // SMALLER,
        focal=intrinsics.focal / SMALLER,
        principal_point=intrinsics.principal_point / SMALLER,
    )
    return replace(cameras, intrinsics=small)


if __name__ == "__main__":
    main()
