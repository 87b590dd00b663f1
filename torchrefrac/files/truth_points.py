"""`truth_points.npz` beside `truth.json`: the true surface point of every few pixels. For evaluation only."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from torchrefrac.files.npz import read_arrays
from torchrefrac.files.truth import load_truth
from torchrefrac.scene import TruthPoints
from torchrefrac.scene.capture import CaptureError

FILE = "truth_points.npz"
CENTER_OF_FIRST_PIXEL = 0.5  # the file counts from the centre of the first pixel, OpenCV's convention


def load_truth_points(folder: Path, names: Sequence[str]) -> TruthPoints | None:
    """Read `folder`/truth_points.npz; None where there is none.

    The images of the file are those of truth.json, in its order. The result has those that `names` lists, in the order
    of `names`; a name that truth.json does not have is left out. In the file, X (m, h, w, 3) holds the points, NaN
    where there is none, plane (m, h, w) the indices of their planes, and the scalars step and offset say at which pixel
    an entry was taken, counted from the centre of the first pixel. Raises CaptureError where one of the files is
    damaged, or the two do not fit together.
    """
    path = folder / FILE
    if not path.is_file():
        return None
    truth = load_truth(folder, with_surface=False)
    if truth is None:
        raise CaptureError(f"{folder / 'truth.json'} does not exist, but names the images of {path}")
    found = read_arrays(path, {"X": "f:mhw3", "plane": "i:mhw", "step": "i:", "offset": "n:"}, CaptureError)
    points, plane, step = found["X"], found["plane"], int(found["step"])
    if step < 1:
        raise CaptureError(f"{path}: step is {step}, but must be a whole number of pixels, 1 at least")
    if len(points) != len(truth.names):
        raise CaptureError(f"{path}: X is of {len(points)} images, but truth.json has {len(truth.names)}")
    if plane.size and plane.max() >= max(len(truth.corner), 1):
        raise CaptureError(f"{path}: plane has {plane.max()}, but truth.json has {len(truth.corner)} planes")
    known = [name for name in names if name in truth.names]
    rows = [truth.names.index(name) for name in known]
    chosen = torch.from_numpy(points[rows].astype(np.float64))
    valid = chosen.isfinite().all(dim=-1)
    return TruthPoints(
        names=tuple(known),
        step=step,
        offset=float(found["offset"]) + CENTER_OF_FIRST_PIXEL,
        points=torch.where(valid[..., None], chosen, 0.0),
        plane=torch.from_numpy(plane[rows]),
        valid=valid,
    )
