"""Learn the water's refractive index, the height of its surface and the focal length, by photometric loss alone.

    python examples/learn_water.py [--index-ratio 1.25] [--height 3.0] [--focal 1.0] [--steps 60]

The embedded tank was photographed by eight cameras; their poses and the three textured boards in the water have been
surveyed, but nobody knows water or focal length exactly. Start from a wrong guess: a pixel of one image is followed
through the surface to the board it sees, and from there into the next image. Where index ratio, height and focal length
are right, both show the same colour. The derivatives pass through both refractions; Adam does the rest, from blurred
images to sharp ones.
"""

import argparse
import json
from dataclasses import replace

import cv2
import torch
from torch import Tensor
from torch.nn import functional
from tqdm import tqdm

import torchrefrac as tr
from torchrefrac.files.library import embedded_scene

BLURS = (12.0, 6.0, 3.0, 1.5)  # pixels
LEARNT = ("index_ratio", "plane_height", "focal")
PIXELS = 4000  # of each image a step


def main() -> None:
    parser = argparse.ArgumentParser(description="Learn index ratio, water level and focal length from images.")
    parser.add_argument("--index-ratio", type=float, default=1.25, help="the guess to start from")
    parser.add_argument("--height", type=float, default=3.0, help="guess of the water level, cm above the true one")
    parser.add_argument("--focal", type=float, default=1.0, help="guess of the focal length, %% above the true one")
    parser.add_argument("--steps", type=int, default=60, help="steps of Adam at each of the four blurs")
    arguments = parser.parse_args()
    images, cameras, boards, true_ratio = load()
    guess = tr.FlatInterface(arguments.index_ratio, plane=tr.Plane(offset=arguments.height))
    intrinsics = replace(cameras.intrinsics, focal=cameras.intrinsics.focal * (1.0 + arguments.focal / 100.0))
    model = tr.LearnableCamera(replace(cameras, intrinsics=intrinsics, interface=guess), learn=LEARNT)
    learn_water(model, images, boards, arguments.steps)
    focal = float(cameras.intrinsics.focal[0])
    print(f"truth             focal length {focal:.2f} px   index ratio {true_ratio:.4f}   water level {0.0:+.3f} cm")


def learn_water(model: tr.LearnableCamera, images: Tensor, boards: list[Tensor], steps: int) -> None:
    """Train `model` (M cameras) on images (M, C, H, W) of `boards`, printing what it has learnt at each blur."""
    generator = torch.Generator().manual_seed(0)
    optimizer = torch.optim.Adam(
        [
            {"params": [model.index_ratio], "lr": 0.02},
            {"params": [model.plane_height], "lr": 0.1},
            {"params": [model.focal], "lr": 0.002},
        ]
    )
    schedule = torch.optim.lr_scheduler.ExponentialLR(optimizer, gamma=0.05 ** (1.0 / (len(BLURS) * steps)))
    _report("guess", model)
    for blur in BLURS:
        smooth = _blurred(images, blur)
        for _ in tqdm(range(steps), desc=f"blur {blur:4.1f} px", unit="step", leave=False):
            optimizer.zero_grad()
            loss = photometric_loss(model.camera, smooth, boards, generator)
            loss.backward()
            optimizer.step()
            schedule.step()
        _report(f"blur {blur:4.1f} px", model)


def photometric_loss(
    camera: tr.RefractiveCamera, images: Tensor, boards: list[Tensor], generator: torch.Generator
) -> Tensor:
    """Mean absolute difference of colours between every image and the next, at random pixels that see a board."""
    count, size = len(images), images.new_tensor((camera.intrinsics.width, camera.intrinsics.height))
    pixels = torch.rand((count, PIXELS, 2), generator=generator, dtype=images.dtype) * size
    origins, directions, valid = camera[:, None].cast_rays(pixels)
    points, hit = first_hit(origins, directions, boards)
    order = torch.arange(count).roll(-1)
    there, seen = camera[order][:, None].project(points, inside_image=True)
    difference = _sample(images[order], there, size) - _sample(images, pixels, size)
    mask = valid & hit & seen
    return (difference.abs().mean(dim=-1) * mask).sum() / mask.sum()


def first_hit(origins: Tensor, directions: Tensor, boards: list[Tensor]) -> tuple[Tensor, Tensor]:
    """Where rays (*B, 3) meet the first of the boards (3, 3: corner and two edges), and whether they meet any."""
    nearest = torch.full_like(origins[..., 0], torch.inf)
    for corner, edge_1, edge_2 in boards:
        normal = torch.linalg.cross(edge_1, edge_2)
        distance = ((corner - origins) @ normal) / (directions @ normal)
        within = origins + distance[..., None] * directions - corner
        a, b = (within @ edge_1) / (edge_1 @ edge_1), (within @ edge_2) / (edge_2 @ edge_2)
        meets = (distance > 0) & (a >= 0) & (a <= 1) & (b >= 0) & (b <= 1)
        nearest = torch.where(meets & (distance < nearest), distance, nearest)
    hit = nearest.isfinite()
    return origins + torch.where(hit, nearest, 1.0)[..., None] * directions, hit


def _sample(images: Tensor, pixels: Tensor, size: Tensor) -> Tensor:
    """Colours (M, N, C) of images (M, C, H, W) at pixels (M, N, 2)."""
    grid = (2.0 * pixels / size - 1.0)[:, :, None]
    return functional.grid_sample(images, grid, align_corners=False)[..., 0].transpose(1, 2)


def _blurred(images: Tensor, sigma: float) -> Tensor:
    """Gaussian blur, and every pixel's colour on a scale where the images' contrast is 1."""
    stack = images.permute(0, 2, 3, 1).numpy()
    smooth = torch.stack([torch.from_numpy(cv2.GaussianBlur(image, (0, 0), sigma)) for image in stack])
    return (smooth / smooth.std()).permute(0, 3, 1, 2)


def _report(stage: str, model: tr.LearnableCamera) -> None:
    with torch.no_grad():
        interface, focal = model.camera.interface, model.camera.intrinsics.focal
    level = torch.as_tensor(interface.plane.offset)
    water = f"index ratio {float(interface.index_like(level)):.4f}   water level {float(level):+.3f} cm"
    print(f"{stage:<17} focal length {float(focal[0]):.2f} px   {water}")


def load() -> tuple[Tensor, tr.RefractiveCamera, list[Tensor], float]:
    folder = embedded_scene("tank_small")
    capture = tr.load_capture(folder)
    truth = json.loads((folder / "truth.json").read_text(encoding="utf-8"))
    pictures = [cv2.imread(str(folder / "images" / image["name"])) for image in truth["images"]]
    images = torch.stack([torch.from_numpy(picture).permute(2, 0, 1).double() for picture in pictures])
    rotation, center = (
        torch.tensor([image[key] for image in truth["images"]], dtype=torch.float64)
        for key in ("cam_from_world_rotation", "center_in_world")
    )
    boards = [torch.tensor([p["origin"], p["e1"], p["e2"]], dtype=torch.float64) for p in truth["planes"]]
    ratio = float(capture.index_ratio)
    return images, tr.RefractiveCamera(capture.cameras[0], rotation, center, tr.FlatInterface(ratio)), boards, ratio


if __name__ == "__main__":
    main()
