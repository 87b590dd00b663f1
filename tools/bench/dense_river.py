"""The dense surface of a river's bed at a depth of 10 m against the truth: precision, recall and F1.

    python tools/bench/dense_river.py [--cells 3,2,1] [--within 0.05,0.1] [--cache FOLDER]

22 photographs of 1024 x 768 pixels from 25 m above the water, rendered by a program that knows nothing of our cameras
(`scene=riverbed scene.depth=10 scene.altitude=25`); a whole run by its defaults, and its dense surface with a patch in
every cell of so many pixels. Precision: share of the points nearer to the true surface than a threshold; recall: share
of the textured places that three photographs show with a point that near; F1: their harmonic mean.
"""

import tempfile
from pathlib import Path

from baseline import bench_parser, figure
from whole_runs import measured_run

from torchrefrac.commands.densify import open_run
from torchrefrac.evaluate.dense_metrics import evaluate_dense
from torchrefrac.evaluate.metrics import evaluate
from torchrefrac.evaluate.textured import points_to_be_found
from torchrefrac.files.dense import load_dense
from torchrefrac.files.truth import load_truth

SCENE = ("scene=riverbed", "scene.depth=10", "scene.altitude=25")


def main() -> None:
    parser = bench_parser("The dense surface of a deep river against the truth.")
    parser.add_argument("--cells", default="3,2,1", help="pixels across of the cells")
    parser.add_argument("--within", default="0.05,0.1", help="distances, m")
    parser.add_argument("--cache", type=Path, help="folder of made scenes, by default the user's cache")
    options = parser.parse_args()
    cache = [] if options.cache is None else [f"cache={options.cache}"]
    within = [float(each) for each in options.within.split(",")]
    print(f"{'cell, px':>8}{'points':>9}{'within, m':>11}{'precision':>11}{'recall':>8}{'F1':>7}{'dense, s':>10}")
    for cell in options.cells.split(","):
        with tempfile.TemporaryDirectory() as folder:
            outputs = [f"outputs.{name}=false" for name in ("mesh", "raster", "depth_maps")]
            run = ("dense=patch", f"dense.cell={cell}", *outputs, "report=false", *cache)
            metrics = measured_run(*SCENE, *run, out=Path(folder))
            scene, cloud = open_run(Path(folder)).scene, load_dense(Path(folder) / "dense.ply")
        assert scene.capture is not None
        truth = load_truth(scene.capture.folder)
        assert truth is not None
        _, alignment = evaluate(scene, truth)
        assert alignment is not None
        found = evaluate_dense(cloud, truth, alignment, points_to_be_found(truth, scene), within)
        for each in within:
            precision, recall = (
                float(found[f"dense_{name}_within_{each:g}_m"])  # type: ignore[arg-type]
                for name in ("accuracy", "completeness")
            )
            both = 2.0 * precision * recall / (precision + recall)
            print(
                f"{cell:>8}{len(cloud):>9}{each:>11g}{precision:>11.3f}{recall:>8.3f}{both:>7.3f}"
                f"{metrics['seconds_dense']:>10.0f}"
            )
            figure(f"cell {cell}: F1 within {each:g} m", both, "", "higher", 0.01)


if __name__ == "__main__":
    main()
