"""The image of a bent ray in another camera, followed by chords."""

from typing import NamedTuple

import torch
from torch import Tensor

from torchrefrac.camera import RefractiveCamera
from torchrefrac.checks import require, require_broadcasting
from torchrefrac.dense.rays import PixelRays

COARSE = 33  # samples of a curve whose course is not known yet
MOST_SAMPLES = 512
MIN_CHORD = 1e-6  # pixels
MARGIN = 32.0  # pixels around where the other points lie


class Curve(NamedTuple):
    """pixels (n, s, 2) at distances (n, s), in ascending order, and which of them are valid (n, s)."""

    pixels: Tensor
    distance: Tensor
    valid: Tensor


def project_curve(
    rays: PixelRays, camera: RefractiveCamera, near: Tensor, far: Tensor, samples: int
) -> tuple[Tensor, Tensor, Tensor]:
    """The images of rays (n) in another camera: pixels (n, samples, 2), distances (n, samples), validity (n, samples).

    At `samples` evenly spaced distances from near (n) to far (n), both included. Not valid is what the camera cannot
    see; pixels may lie outside of its image.

    Raises ValueError for a batch of cameras, fewer than 2 samples, and a near that is above far.
    """
    near, far = checked_range(rays, camera, near, far)
    require(samples, "samples", at_least=2)
    curve = sample(rays, camera, evenly(near, far, samples))
    return curve.pixels, curve.distance, curve.valid


def sample(rays: PixelRays, camera: RefractiveCamera, distance: Tensor) -> Curve:
    """The curve of each ray (n) at distances (n, s)."""
    pixels, valid = camera.project(rays[:, None].at(distance))
    return Curve(pixels, distance, valid)


def follow(
    rays: PixelRays, camera: RefractiveCamera, near: Tensor, far: Tensor, frame: Tensor, spacing: float
) -> Curve:
    """Samples about `spacing` pixels apart within the frame (2, 2), one of them where the ray enters the water."""
    surface = torch.zeros_like(near).clamp(near, far)[:, None]
    distance = evenly(near, far, COARSE)
    for apart in (4.0 * spacing, spacing):
        curve = sample(rays, camera, torch.cat((distance, surface), dim=1).sort(dim=1).values)
        length = _length(curve, frame)
        distance = _spread(curve.distance, length, min(int(length[:, -1].max() / apart) + 2, MOST_SAMPLES))
    return sample(rays, camera, torch.cat((distance, surface), dim=1).sort(dim=1).values)


def evenly(near: Tensor, far: Tensor, samples: int) -> Tensor:
    """Distances (n, samples) from near (n) to far (n)."""
    part = torch.linspace(0.0, 1.0, samples, dtype=near.dtype, device=near.device)
    return torch.lerp(near[:, None], far[:, None], part)


def _length(curve: Curve, frame: Tensor) -> Tensor:
    """Pixels from the first sample to each (n, s) along the chords, as far as they lie in the frame.

    Strictly ascending. A chord with one valid end counts as the longest that there is.
    """
    chord = within(curve.pixels, frame).diff(dim=1).norm(dim=-1)
    both, either = curve.valid[:, 1:] & curve.valid[:, :-1], curve.valid[:, 1:] | curve.valid[:, :-1]
    longest = (frame[1] - frame[0]).norm()
    chord = torch.where(both, chord, torch.where(either, longest, 0.0)) + MIN_CHORD
    return torch.nn.functional.pad(chord.cumsum(dim=1), (1, 0))


def _spread(distance: Tensor, length: Tensor, samples: int) -> Tensor:
    """Distances (n, samples) evenly spaced in length, which is known (n, s) at distances (n, s)."""
    wanted = length[:, -1:] * torch.linspace(0.0, 1.0, samples, dtype=length.dtype, device=length.device)
    index = torch.searchsorted(length, wanted, right=True).clamp(1, length.shape[1] - 1)
    start, end = length.gather(1, index - 1), length.gather(1, index)
    share = ((wanted - start) / (end - start)).clamp(0.0, 1.0)
    return torch.lerp(distance.gather(1, index - 1), distance.gather(1, index), share)


def frame_of(pixels: Tensor, band: float) -> Tensor:
    """The least and the greatest pixels (2, 2) of all that may lie in the band of one of pixels (m, 2), and a margin.

    Within the margin a chord may depart from its curve.
    """
    return torch.stack((pixels.amin(dim=0), pixels.amax(dim=0))) + pixels.new_tensor([[-1.0], [1.0]]) * (band + MARGIN)


def within(pixels: Tensor, frame: Tensor) -> Tensor:
    """Pixels moved into the frame: of a chord, the part that lies there stays within the box around its moved ends."""
    return pixels.clamp(frame[0], frame[1])


def checked_range(rays: PixelRays, camera: RefractiveCamera, near: Tensor, far: Tensor) -> tuple[Tensor, Tensor]:
    """near and far (n) in the rays' dtype."""
    if camera.shape:
        raise ValueError(f"camera has batch shape {tuple(camera.shape)}, but must be a single camera")
    shape = require_broadcasting(rays=rays.origin.shape[:-1], near=near.shape, far=far.shape)
    near, far = (value.to(rays.origin).expand(shape) for value in (near, far))
    require(far - near, "far - near", at_least=0.0)
    return near, far
