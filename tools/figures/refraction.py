"""Draw the figures of docs/refraction.md.

python tools/figures/refraction.py [docs/figures]
"""

import argparse
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import torchrefrac as tr

WATER, AIR, INK, RED = "#cfe6f5", "#ffffff", "#1b3a57", "#c0392b"
DEPTHS = (0.5, 1.0, 2.0, 5.0)


def main() -> None:
    parser = argparse.ArgumentParser(description="Draw the figures of docs/refraction.md.")
    parser.add_argument("folder", nargs="?", type=Path, default=Path("docs/figures"))
    folder = parser.parse_args().folder
    plt.rcParams.update({"font.size": 10, "axes.spines.top": False, "axes.spines.right": False})
    for name, draw in (("ray_path", draw_ray_path), ("ignoring_water", draw_ignoring_water)):
        figure = draw()
        figure.savefig(folder / f"{name}.png", dpi=130)
        plt.close(figure)
        print(folder / f"{name}.png")


def draw_ray_path() -> Figure:
    """One ray through the surface, with the quantities of the derivation; and the layers of an aquarium wall."""
    figure, (left, right) = plt.subplots(1, 2, figsize=(10, 4.6), layout="constrained", width_ratios=(1.15, 1.0))
    height, depth, distance, ratio = 1.0, 1.2, 1.9, 1.333
    refrax = distance * float(tr.solve_refrax(height, depth, distance, ratio))
    apparent = distance / refrax * height - height
    left.axhspan(-1.9, 0.0, color=WATER, lw=0)
    left.axhline(0.0, color=INK, lw=1.2)
    left.plot([0, refrax, distance], [height, 0, -depth], color=INK, lw=1.8)
    left.plot([refrax, distance], [0, -apparent], color=RED, lw=1.2, ls="--")
    left.plot([0, distance], [height, -depth], color="0.6", lw=1.0, ls=":")
    left.plot([distance, distance], [-apparent, -depth], color=RED, lw=0.8, ls=":")
    left.plot([0, 0], [0, height], color="0.5", lw=0.8)
    for x, y, text, side in (
        (0, height, "camera c", "left"),
        (refrax, 0, "refrax", "left"),
        (distance, -depth, "point p", "left"),
        (distance, -apparent, "where p appears", "left"),
    ):
        left.plot(x, y, "o", color=RED if "appears" in text else INK, ms=5)
        left.annotate(text, (x, y), xytext=(7, 6), textcoords="offset points", ha=side)
    left.text(-0.06, height / 2, "h", ha="right", va="center", style="italic")
    left.text(distance + 1.02, -depth / 2, "d", ha="left", va="center", style="italic")
    left.annotate("", (distance + 0.98, 0), (distance + 0.98, -depth), arrowprops={"arrowstyle": "<->", "color": "0.5"})
    left.annotate("", (0, -1.55), (refrax, -1.55), arrowprops={"arrowstyle": "<->", "color": "0.5"})
    left.annotate("", (0, -1.75), (distance, -1.75), arrowprops={"arrowstyle": "<->", "color": "0.5"})
    left.text(refrax / 2, -1.53, r"$\lambda a$", ha="center", va="bottom")
    left.text((refrax + distance) / 2, -1.73, "$a$", ha="center", va="bottom")
    left.annotate("", (-0.32, height), (-0.32, -apparent), arrowprops={"arrowstyle": "<->", "color": RED})
    left.text(-0.36, -0.05, "H", color=RED, ha="right", va="top", style="italic")
    left.set(xlim=(-0.6, 3.1), ylim=(-1.9, 1.35), aspect="equal", title="One surface: p appears lifted to depth H - h")
    left.axis("off")
    _draw_wall(right)
    return figure


def _draw_wall(axes: Axes) -> None:
    glass = 0.35
    wall = tr.FlatInterface.glass_wall(tr.Plane((-1.0, 0.0, 0.0), 0.0), glass)
    axes.axvspan(0.0, glass, color="#d8d8d8", lw=0)
    axes.axvspan(glass, 2.2, color=WATER, lw=0)
    camera = torch.tensor([-1.0, 0.0, 0.0], dtype=torch.float64)
    for target in (-1.3, -0.45, 0.45, 1.3):
        point = torch.tensor([2.0, 0.0, target], dtype=torch.float64)
        offset, _ = tr.refraction.lift_points(camera, point, wall)
        bare = tr.FlatInterface(layers=(1.0, 1.52), plane=wall.plane)
        first, _, _ = tr.refraction.refract_rays(camera, offset, bare)
        last, _, _ = tr.refraction.refract_rays(camera, offset, wall)
        path = torch.stack((camera, first, last, point)).numpy()
        axes.plot(path[:, 0], path[:, 2], color=INK, lw=1.6)
        seen = camera + offset
        axes.plot([float(first[0]), float(seen[0])], [float(first[2]), float(seen[2])], color=RED, lw=1.0, ls="--")
        axes.plot(float(point[0]), float(point[2]), "o", color=INK, ms=5)
        axes.plot(float(seen[0]), float(seen[2]), "o", color=RED, ms=5)
    axes.plot(-1.0, 0.0, "o", color=INK, ms=5)
    for x, text in ((-0.55, "air"), (glass / 2, "glass"), (1.45, "water")):
        axes.text(x, 1.62, text, ha="center", color=INK)
    axes.set(xlim=(-1.2, 2.2), ylim=(-1.75, 1.85), aspect="equal", title="Layers: points, and where they appear (red)")
    axes.axis("off")


def draw_ignoring_water() -> Figure:
    """What a camera 1 m above the water gets wrong where refraction is ignored."""
    figure, (left, right) = plt.subplots(1, 2, figsize=(10, 4.0), layout="constrained")
    angle = torch.deg2rad(torch.linspace(0.0, 75.0, 300, dtype=torch.float64))
    shades = plt.get_cmap("viridis_r")(np.linspace(0.15, 0.9, len(DEPTHS)))
    up = tr.Intrinsics.create(4000, 3000, 3000.0)
    nadir = torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))
    for depth, shade in zip(DEPTHS, shades, strict=True):
        in_water = torch.asin(angle.sin() / 1.333)
        distance = angle.tan() + depth * in_water.tan()
        lifted = distance / angle.tan().clamp(min=1e-9)
        lifted[0] = 1.0 + depth / 1.333
        left.plot(torch.rad2deg(angle), depth - (lifted - 1.0), color=shade, label=f"{depth:g} m deep")
        points = torch.stack((distance, torch.zeros_like(distance), torch.full_like(distance, -depth)), dim=-1)
        camera = tr.RefractiveCamera(up, nadir, torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64), tr.FlatInterface())
        shift, _ = camera.refraction_shift(points)
        seen = camera.project(points, inside_image=True)[1]
        right.plot(torch.rad2deg(angle)[seen], shift.norm(dim=-1)[seen], color=shade, label=f"{depth:g} m deep")
    left.set(xlabel="angle of incidence in air (degrees)", ylabel="depth missed (m)", ylim=(0, None))
    left.set_title("How much too shallow a point appears")
    right.set(xlabel="angle of incidence in air (degrees)", ylabel="shift in the image (pixels)", ylim=(0, None))
    right.set_title("Nadir camera 1 m above the water, f = 3000 px")
    left.legend(frameon=False)
    right.legend(frameon=False)
    return figure


if __name__ == "__main__":
    main()
