"""The renderer of made scenes: seconds an image, and agreement with an independent ray tracer.

    python tools/bench/rendering.py [--only tank|cans|riverbed|agreement] [--threads 2]

tank (three rectangles), cans (rectangles and cylinders), riverbed (a mesh): 1024 x 768 pixels of 4 x 4 rays, without
what is made once for a scene. agreement: each photograph of the embedded tank, which POV-Ray made, against the same
rendered here in the colours of the seven others: the median over windows of 64 pixels of the shift between the two, the
shift that all windows have in common, and the median difference of a grey value.
"""

import time

import numpy as np
import torch
from agreement import Tank
from baseline import bench_parser, figure

from torchrefrac.synthetic.options import SyntheticOptions
from torchrefrac.synthetic.photograph import Photographer
from torchrefrac.synthetic.scenes import CansOptions, RiverbedOptions, TankOptions, stage_of

SCENES = {"tank": TankOptions, "cans": CansOptions, "riverbed": RiverbedOptions}
IMAGES = 4
SAMPLES = 2


def main() -> None:
    parser = bench_parser("Speed of the renderer, and agreement with POV-Ray.")
    parser.add_argument("--only", choices=(*SCENES, "agreement"), help="by default everything")
    parser.add_argument("--threads", type=int, default=2)
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    for name, options in SCENES.items():
        if arguments.only in (None, name):
            _time(options(name=name))
    if arguments.only in (None, "agreement"):
        _agree()


def _time(options: SyntheticOptions) -> None:
    start = time.perf_counter()
    photographer = Photographer.of(stage_of(options), options)
    photographer.look(0, torch.zeros(1, 2, dtype=torch.float64))  # what is prepared once for a scene
    once = time.perf_counter() - start
    walls, processors = [], []
    for image in range(IMAGES):
        wall, processor = time.perf_counter(), time.process_time()
        photographer.take(image)
        walls.append(time.perf_counter() - wall)
        processors.append(time.process_time() - processor)
    print(
        f"{options.name:<9} {min(walls):6.2f} s an image on {torch.get_num_threads()} threads (best of {IMAGES}, worst "
        f"{max(walls):.2f}), {min(processors):.2f} s of processor time; {once:.1f} s once",
        flush=True,
    )
    figure(f"{options.name}: processor time of an image", min(processors), "s", "lower", 0.2)


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
    figure("agreement with POV-Ray, worst photograph", worst, "px", "lower")
    print(f"worst photograph {worst:.4f} px, all windows {np.median([a.shift for a in found]):.4f} px")


if __name__ == "__main__":
    main()
