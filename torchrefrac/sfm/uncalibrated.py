"""Cameras as a program has them that knows of each photograph what its EXIF says, and nothing of a calibration."""

from dataclasses import replace

import torch

from torchrefrac.files.metadata.lens import focal_of_equivalent
from torchrefrac.scene import Cameras, Capture


def uncalibrated(capture: Capture) -> Capture:
    """The capture with a camera of its own for each photograph, of which only the focal length is known, roughly.

    It is what EXIF says, the equivalent on 35 mm film in whole millimetres (1 at least); there is no distortion, and
    the principal point is in the middle. None of it has an expected error: what an adjustment refines varies freely.
    """
    known, names = capture.cameras, capture.names
    sizes = tuple(known.sizes[row] for row in capture.camera.tolist())
    of_film = known.focal.new_tensor([focal_of_equivalent(1.0, *size) for size in sizes])
    equivalent = (known.focal[capture.camera].mean(dim=-1) / of_film).round().clamp(min=1.0)
    cameras = Cameras(
        sizes,
        (equivalent * of_film)[:, None].repeat(1, 2),
        0.5 * known.focal.new_tensor(sizes),
        known.distortion.new_zeros(len(sizes), known.distortion.shape[1]),
        names=names,
    )
    return replace(capture, cameras=cameras, camera=torch.arange(len(names)))
