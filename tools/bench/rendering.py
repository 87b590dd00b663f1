"""The renderer of made scenes: seconds an image, and agreement with an independent ray tracer.

    python tools/bench/rendering.py [--only planes|field|agreement] [--threads 2]

planes: three rectangles in a tank; field: a height field of a million faces; both 1024 x 768 pixels of 4 x 4 rays.
agreement: each photograph of the embedded tank, which POV-Ray made, against the same rendered here in the colours of
the seven others: the median over windows of 64 pixels of the shift between the two, the shift that all windows have in
common, and the median difference of a grey value.
"""

import argparse
import math
import time
from collections.abc import Callable

import numpy as np
import torch
from agreement import Tank
from torch import Tensor

from torchrefrac.geometry.surfaces import Rectangle
from torchrefrac.geometry.triangle_mesh import TriangleMesh
from torchrefrac.scene.synthetic.options import SyntheticOptions
from torchrefrac.scene.synthetic.paths import look_at, ring
from torchrefrac.scene.synthetic.photograph import Photographer
from torchrefrac.scene.synthetic.stage import Piece, Stage
from torchrefrac.scene.synthetic.textures import ImageTexture

IMAGES = 4
FIELD_SIDE = 708  # cells, two faces each
SAMPLES = 2


def main() -> None:
    parser = argparse.ArgumentParser(description="Speed of the renderer, and agreement with POV-Ray.")
    parser.add_argument("--only", choices=("planes", "field", "agreement"), help="by default everything")
    parser.add_argument("--threads", type=int, default=2)
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    jobs: dict[str, Callable[[], None]] = {
        "planes": lambda: _time("three planes", _planes()),
        "field": lambda: _time("a million faces", _field()),
        "agreement": _agree,
    }
    for name, job in jobs.items():
        if arguments.only in (None, name):
            job()


def _time(label: str, pieces: tuple[Piece, ...]) -> None:
    center = ring(IMAGES, 60.0, (30.0, 40.0), (0.0, 360.0))
    stage = Stage(pieces, look_at(center, torch.tensor((0.0, 0.0, -75.0)).double().expand_as(center)), center, "cm")
    photographer = Photographer.of(stage, SyntheticOptions(name="bench"))
    photographer.look(0, torch.zeros(1, 2, dtype=torch.float64))  # what is prepared once for a scene
    walls, processors = [], []
    for image in range(IMAGES):
        wall, processor = time.perf_counter(), time.process_time()
        photographer.take(image)
        walls.append(time.perf_counter() - wall)
        processors.append(time.process_time() - processor)
    threads = torch.get_num_threads()
    print(
        f"{label:<16} {min(walls):6.2f} s an image on {threads} threads (best of {IMAGES}), "
        f"{min(processors):.2f} s of processor time, {len(photographer.stage.pieces)} pieces",
        flush=True,
    )


def _agree() -> None:
    tank = Tank()
    print(f"{'photograph':<12} {'windows':>8} {'|shift| px':>11} {'in common px':>20} {'grey levels':>12} {'bias':>7}")
    found = []
    for image, name in enumerate(tank.capture.names):
        a = tank.agreement(image, SAMPLES)
        found.append(a)
        x, y = a.mean_shift
        print(
            f"{name:<12} {len(a.shifts):>8} {a.shift:>11.4f} {x:>10.5f}{y:>10.5f} {a.difference:>12.2f} {a.bias:>7.2f}",
            flush=True,
        )
    worst = max(a.shift for a in found)
    print(f"worst photograph {worst:.4f} px, all windows {np.median([a.shift for a in found]):.4f} px")


def _texture(seed: int) -> ImageTexture:
    return ImageTexture(np.random.default_rng(seed).integers(0, 256, (2048, 2048, 3), dtype=np.uint8))


def _vector(*components: float) -> Tensor:
    return torch.tensor(components, dtype=torch.float64)


def _planes() -> tuple[Piece, ...]:
    x, z = 75.0 * math.cos(math.radians(30.0)), 75.0 * math.sin(math.radians(30.0))
    rectangles = (
        Rectangle(_vector(-100.0, -100.0, -100.0), _vector(200.0, 0.0, 0.0), _vector(0.0, 200.0, 0.0)),
        Rectangle(_vector(-18.0, -45.0, -92.0), _vector(0.0, 90.0, 0.0), _vector(-x, 0.0, z)),
        Rectangle(_vector(18.0, 45.0, -92.0), _vector(0.0, -90.0, 0.0), _vector(x, 0.0, z)),
    )
    return tuple(Piece(f"plane {i}", plane, _texture(i), is_plane=True) for i, plane in enumerate(rectangles))


def _field() -> tuple[Piece, ...]:
    side = FIELD_SIDE + 1
    unit = torch.linspace(0.0, 1.0, side, dtype=torch.float64)
    v, u = torch.meshgrid(unit, unit, indexing="ij")
    x, y = 240.0 * u - 120.0, 240.0 * v - 120.0
    vertices = torch.stack((x, y, -80.0 + 15.0 * (x / 9.0).sin() * (y / 7.0).cos()), dim=-1).reshape(-1, 3)
    number = torch.arange(side * side).reshape(side, side)
    a, b, c, d = (part.flatten() for part in (number[:-1, :-1], number[:-1, 1:], number[1:, :-1], number[1:, 1:]))
    faces = torch.cat((torch.stack((a, b, d), dim=-1), torch.stack((a, d, c), dim=-1)))
    return (Piece("field", TriangleMesh(vertices, faces, torch.stack((u, v), dim=-1).reshape(-1, 2)), _texture(0)),)


if __name__ == "__main__":
    main()
