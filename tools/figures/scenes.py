"""Draw docs/figures/scenes.jpg: three photographs of each scene that can be made.

python -m tools.figures.scenes [docs/figures], from the root of the repository
"""

import argparse
from pathlib import Path

import cv2
import numpy as np

from torchrefrac.synthetic.options import CameraOptions, SyntheticOptions
from torchrefrac.synthetic.photograph import Photographer, develop
from torchrefrac.synthetic.scenes import (
    AquariumOptions,
    CansOptions,
    HousingOptions,
    RiverbedOptions,
    TankOptions,
    stage_of,
)

WIDTH, HEIGHT, GAP = 400, 300, 6
SCENES: tuple[tuple[SyntheticOptions, tuple[int, ...]], ...] = (
    (TankOptions(name="tank", camera=CameraOptions(width=WIDTH, height=HEIGHT, fov_deg=75.0)), (0, 4, 9)),
    (CansOptions(name="cans", camera=CameraOptions(width=WIDTH, height=HEIGHT, fov_deg=60.0)), (1, 7, 14)),
    (RiverbedOptions(name="riverbed", camera=CameraOptions(width=WIDTH, height=HEIGHT, fov_deg=65.0)), (5, 12, 18)),
    (AquariumOptions(name="aquarium", camera=CameraOptions(width=WIDTH, height=HEIGHT, fov_deg=60.0)), (0, 4, 10)),
    (HousingOptions(name="housing", camera=CameraOptions(width=WIDTH, height=HEIGHT, fov_deg=75.0)), (3, 8, 17)),
)


def main() -> None:
    parser = argparse.ArgumentParser(description="Draw docs/figures/scenes.jpg.")
    parser.add_argument("folder", nargs="?", type=Path, default=Path("docs/figures"))
    path = parser.parse_args().folder / "scenes.jpg"
    rows = [_row(options, images) for options, images in SCENES]
    sheet = np.concatenate([part for row in rows for part in (row, _white(GAP, row.shape[1]))][:-1], axis=0)
    cv2.imwrite(str(path), sheet[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 75])
    print(f"wrote {path}, {path.stat().st_size // 1000} kB")


def _row(options: SyntheticOptions, images: tuple[int, ...]) -> np.ndarray:
    photographer = Photographer.of(stage_of(options), options)
    parts = []
    for image in images:
        parts += [develop(photographer.take(image), options.sensor, options.seed, image), _white(HEIGHT, GAP)]
    return np.concatenate(parts[:-1], axis=1)


def _white(height: int, width: int) -> np.ndarray:
    return np.full((height, width, 3), 255, dtype=np.uint8)


if __name__ == "__main__":
    main()
