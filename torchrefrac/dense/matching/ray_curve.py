"""The image of a bent ray in another camera, followed by chords."""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchrefrac.camera import RefractiveCamera
from torchrefrac.checks import require, require_broadcasting
from torchrefrac.dense.rays import PixelRays

COARSE = 33  # samples of a curve whose course is not known yet
MOST_SAMPLES = 512
MIN_CHORD = 1e-6  # pixels
MARGIN = 32.0  # pixels around where the other points lie


class Curve(NamedTuple):
    """Pixels at distances, in ascending order, and which of them are valid, of each of n rays."""

    pixels: Float[Tensor, "n s 2"]
    distance: Float[Tensor, "n s"]
    valid: Bool[Tensor, "n s"]


def project_curve(
    rays: PixelRays, camera: RefractiveCamera, near: Float[Tensor, "..."], far: Float[Tensor, "..."], samples: int
) -> Curve:
    """The images of rays (n) in another camera, at `samples` evenly spaced distances from near to far, both included.

    Not valid is what the camera cannot see; pixels may lie outside of its image.

    Raises ValueError for a batch of cameras, fewer than 2 samples, and a near that is above far.
    """
    near, far = checked_range(rays, camera, near, far)
    require(samples, "samples", at_least=2)
    return sample(rays, camera, evenly(near, far, samples))


def sample(rays: PixelRays, camera: RefractiveCamera, distance: Float[Tensor, "n s"]) -> Curve:
    """The curve of each ray (n) at distances."""
    pixels, valid = camera.project(rays[:, None].at(distance))
    return Curve(pixels, distance, valid)


def follow(
    rays: PixelRays,
    camera: RefractiveCamera,
    near: Float[Tensor, " n"],
    far: Float[Tensor, " n"],
    frame: Float[Tensor, "2 2"],
    spacing: float,
) -> Curve:
    """Samples about `spacing` pixels apart within the frame, one of them where the ray enters the water."""
    surface = torch.zeros_like(near).clamp(near, far)[:, None]
    distance = evenly(near, far, COARSE)
    for apart in (4.0 * spacing, spacing):
        curve = sample(rays, camera, torch.cat((distance, surface), dim=1).sort(dim=1).values)
        length = _length(curve, frame)
        distance = _spread(curve.distance, length, min(int(length[:, -1].max() / apart) + 2, MOST_SAMPLES))
    return sample(rays, camera, torch.cat((distance, surface), dim=1).sort(dim=1).values)


def evenly(near: Float[Tensor, " n"], far: Float[Tensor, " n"], samples: int) -> Float[Tensor, "n {samples}"]:
    """Distances from near to far."""
    part = torch.linspace(0.0, 1.0, samples, dtype=near.dtype, device=near.device)
    return torch.lerp(near[:, None], far[:, None], part)


def _length(curve: Curve, frame: Float[Tensor, "2 2"]) -> Float[Tensor, "n s"]:
    """Pixels from the first sample to each along the chords, as far as they lie in the frame.

    Strictly ascending. A chord with one valid end counts as the longest that there is.
    """
    chord = within(curve.pixels, frame).diff(dim=1).norm(dim=-1)
    both, either = curve.valid[:, 1:] & curve.valid[:, :-1], curve.valid[:, 1:] | curve.valid[:, :-1]
    longest = (frame[1] - frame[0]).norm()
    chord = torch.where(both, chord, torch.where(either, longest, 0.0)) + MIN_CHORD
    return torch.nn.functional.pad(chord.cumsum(dim=1), (1, 0))


def _spread(distance: Float[Tensor, "n s"], length: Float[Tensor, "n s"], samples: int) -> Float[Tensor, "n {samples}"]:
    """Distances evenly spaced in length, which is known at the given ones."""
    wanted = length[:, -1:] * torch.linspace(0.0, 1.0, samples, dtype=length.dtype, device=length.device)
    index = torch.searchsorted(length, wanted, right=True).clamp(1, length.shape[1] - 1)
    start, end = length.gather(1, index - 1), length.gather(1, index)
    share = ((wanted - start) / (end - start)).clamp(0.0, 1.0)
    return torch.lerp(distance.gather(1, index - 1), distance.gather(1, index), share)


def frame_of(pixels: Float[Tensor, "m 2"], band: float) -> Float[Tensor, "2 2"]:
    """The least and the greatest pixels of all that may lie in the band of one of `pixels`, and a margin.

    Within the margin a chord may depart from its curve.
    """
    return torch.stack((pixels.amin(dim=0), pixels.amax(dim=0))) + pixels.new_tensor([[-1.0], [1.0]]) * (band + MARGIN)


def within(pixels: Float[Tensor, "*batch 2"], frame: Float[Tensor, "2 2"]) -> Float[Tensor, "*batch 2"]:
    """Pixels moved into the frame: of a chord, the part that lies there stays within the box around its moved ends."""
    return pixels.clamp(frame[0], frame[1])


def checked_range(
    rays: PixelRays, camera: RefractiveCamera, near: Float[Tensor, "..."], far: Float[Tensor, "..."]
) -> tuple[Float[Tensor, " n"], Float[Tensor, " n"]]:
    """near and far of each ray, in the rays' dtype."""
    if camera.shape:
        raise ValueError(f"camera has batch shape {tuple(camera.shape)}, but must be a single camera")
    shape = require_broadcasting(rays=rays.origin.shape[:-1], near=near.shape, far=far.shape)
    near, far = (value.to(rays.origin).expand(shape) for value in (near, far))
    require(far - near, "far - near", at_least=0.0)
    return near, far
