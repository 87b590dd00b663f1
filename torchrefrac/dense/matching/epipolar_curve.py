"""Which points of another image a reference pixel may match: those along the image of its bent ray.

Through water that image is no line but a curve, with a kink where the ray enters the water. The epipolar constraint is
relaxed to a band along this curve (section 3.6 of the paper; PMVS has a band along a line).
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchrefrac.camera import RefractiveCamera
from torchrefrac.checks import require, require_broadcasting
from torchrefrac.dense.matching.interest_points import InterestPoints, strongest
from torchrefrac.dense.rays import PixelRays, project_moving

CURVES = 1024  # worked on at once
TINY = 1e-30
STEPS = 4  # Gauss-Newton; within the band the curve bends so little that these leave nothing
COARSE = 33  # samples of a curve whose course is not known yet
MOST_SAMPLES = 512
MIN_CHORD = 1e-6  # pixels
MARGIN = 32.0  # pixels around where the other points lie


@dataclass(frozen=True)
class Candidates:
    """k pairs that may match, ordered by `point`, then `other`.

    point: index of the reference point; other: index of the other image's point; distance: along the reference ray (see
    `PixelRays`), where its image passes nearest to the other point; offset: how near, in pixels.
    """

    point: Int[Tensor, " k"]
    other: Int[Tensor, " k"]
    distance: Float[Tensor, " k"]
    offset: Float[Tensor, " k"]

    def __len__(self) -> int:
        return len(self.point)


class Curve(NamedTuple):
    """The images of n rays, followed by chords: pixels at ascending distances, and which of them are valid."""

    pixels: Float[Tensor, "n s 2"]
    distance: Float[Tensor, "n s"]
    valid: Bool[Tensor, "n s"]


def find_candidates(
    rays: PixelRays,
    kind: Int[Tensor, " n"],
    camera: RefractiveCamera,
    others: InterestPoints,
    near: Float[Tensor, "..."],
    far: Float[Tensor, "..."],
    band: float = 2.0,
    spacing: float = 4.0,
) -> Candidates:
    """All points of another image that lie within `band` pixels of the image of a reference ray, and are of its kind.

    rays (n) and kind: of the reference points; camera: of the other image; near, far: distances along the rays between
    which to look. The curves are followed by chords of about `spacing` pixels, longer ones only where 512 do not
    suffice; the nearest place on the curve is then found exactly, on either side of the water.

    Raises ValueError for a batch of cameras, a near that is above far, and a band or spacing that is not above 0.
    """
    if camera.shape:
        raise ValueError(f"camera has batch shape {tuple(camera.shape)}, but must be a single camera")
    shape = require_broadcasting(rays=rays.origin.shape[:-1], near=near.shape, far=far.shape)
    near, far = (value.to(rays.origin).expand(shape) for value in (near, far))
    require(far - near, "far - near", at_least=0.0)
    require(band, "band", above=0.0)
    require(spacing, "spacing", above=0.0)
    parts = [Candidates(*(kind.new_zeros(0, dtype=torch.long),) * 2, *(near.new_zeros(0),) * 2)]
    frame = frame_of(others.pixels.to(near), band) if len(others) else near.new_zeros(2, 2)
    for first in range(0, len(near) if len(others) else 0, CURVES):
        rows = torch.arange(first, min(first + CURVES, len(near)), device=near.device)
        curve = follow(rays[rows], camera, near[rows], far[rows], frame, spacing)
        found = _nearest(rays[rows], kind[rows], camera, curve, others, frame, band)
        parts.append(Candidates(found.point + first, found.other, found.distance, found.offset))
    return Candidates(*(torch.cat([getattr(p, f) for p in parts]) for f in Candidates.__dataclass_fields__))


def _nearest(
    rays: PixelRays,
    kind: Int[Tensor, " n"],
    camera: RefractiveCamera,
    curve: Curve,
    others: InterestPoints,
    frame: Float[Tensor, "2 2"],
    band: float,
) -> Candidates:
    """One pair at most of each row and point: of the nearest places on the chords before and beyond the water."""
    row, chord, other = _near_chords(kind, curve, others, frame, band)
    at = others.pixels.to(curve.pixels)[other]
    start, end = curve.pixels[row, chord], curve.pixels[row, chord + 1]
    along = end - start
    share = ((at - start) * along).sum(dim=-1) / along.square().sum(dim=-1).clamp(min=MIN_CHORD**2)
    gap = (start + share.clamp(0.0, 1.0)[:, None] * along - at).norm(dim=-1)
    before = curve.distance[row, chord + 1] <= 0.0
    nearest = strongest(2 * (row * len(others) + other) + before, -gap, 1)
    row, chord, other = row[nearest], chord[nearest], other[nearest]
    distance, offset, valid = _refined(rays[row], camera, curve.distance, row, chord, at[nearest])
    good = (valid & (offset <= band)).nonzero()[:, 0]
    good = good[strongest(row[good] * len(others) + other[good], -offset[good], 1)]
    return Candidates(row[good], other[good], distance[good], offset[good])


def _near_chords(
    kind: Int[Tensor, " n"], curve: Curve, others: InterestPoints, frame: Float[Tensor, "2 2"], band: float
) -> tuple[Int[Tensor, " k"], Int[Tensor, " k"], Int[Tensor, " k"]]:
    """Rows, chords and points of the same kind that may come within the band of each other.

    Around a chord's middle is searched as far as half of it and the band reach, and half a chord more, which the curve
    may depart from it. Chords are taken together by length, so that few long ones do not make the search wide for all.
    """
    from scipy.spatial import KDTree  # noqa: PLC0415 - slow to import

    inside = within(curve.pixels, frame)
    length = inside.diff(dim=1).norm(dim=-1)
    row, chord = (curve.valid[:, 1:] & curve.valid[:, :-1]).nonzero().unbind(dim=-1)
    reach = band + length[row, chord]
    middle = (inside[row, chord] + inside[row, chord + 1]) / 2.0
    apart = 4.0 * float((frame[1] - frame[0]).norm())  # between the kinds, as a third coordinate

    def tree(pixels: Float[Tensor, "p 2"], of_kind: Int[Tensor, " p"]) -> KDTree:
        points = torch.cat((pixels, apart * of_kind.to(pixels)[:, None]), dim=-1)
        return KDTree(points.cpu().numpy(), balanced_tree=False, compact_nodes=False)

    points = tree(others.pixels.to(middle), others.kind)
    octave = torch.log2(reach).ceil()
    chords, found = [np.zeros(0, dtype=np.int64)], [np.zeros(0, dtype=np.int64)]
    for level in octave.unique().tolist():
        chosen = (octave == level).nonzero()[:, 0]
        near = tree(middle[chosen], kind[row[chosen]]).sparse_distance_matrix(
            points, float(reach[chosen].max()), output_type="ndarray"
        )
        chords.append(chosen.cpu().numpy()[near["i"]])
        found.append(near["j"])
    pick = torch.from_numpy(np.concatenate(chords)).to(row.device)
    return row[pick], chord[pick], torch.from_numpy(np.concatenate(found)).to(row.device)


def _refined(
    rays: PixelRays,
    camera: RefractiveCamera,
    known: Float[Tensor, "n s"],
    row: Int[Tensor, " k"],
    chord: Int[Tensor, " k"],
    at: Float[Tensor, "k 2"],
) -> tuple[Float[Tensor, " k"], Float[Tensor, " k"], Bool[Tensor, " k"]]:
    """Distances along rays whose images lie nearest to the pixels `at`, how near, and validity.

    By Gauss-Newton on the exact projection, from the middle of a chord of a row of `known` distances, as far as the
    chords beside it reach, but not across the water.
    """
    start, end = known[row, chord], known[row, chord + 1]
    lower, upper = known[row, (chord - 1).clamp(min=0)], known[row, (chord + 2).clamp(max=known.shape[1] - 1)]
    before = end <= 0.0
    lower, upper = torch.where(before, lower, lower.clamp(min=0.0)), torch.where(before, upper.clamp(max=0.0), upper)
    direction = torch.where(before[:, None], rays.before, rays.after)
    distance = (start + end) / 2.0
    for _ in range(STEPS):
        pixels, along, _ = project_moving(camera, rays.origin + distance[:, None] * direction, direction)
        step = ((at - pixels) * along).sum(dim=-1) / along.square().sum(dim=-1).clamp(min=TINY)
        distance = (distance + step).clamp(lower, upper)
    pixels, valid = camera.project(rays.origin + distance[:, None] * direction)
    return distance, (pixels - at).norm(dim=-1), valid


def sample(rays: PixelRays, camera: RefractiveCamera, distance: Float[Tensor, "n s"]) -> Curve:
    """The images of rays (n) at distances; not valid is what the camera cannot see."""
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
    """Pixels from the first sample to each along the chords, as far as they lie in the frame. Strictly ascending. A
    chord with one valid end counts as the longest that there is."""
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
    """The least and the greatest pixels of all that may lie in the band of one of `pixels`, and a margin. Within the
    margin a chord may depart from its curve."""
    return torch.stack((pixels.amin(dim=0), pixels.amax(dim=0))) + pixels.new_tensor([[-1.0], [1.0]]) * (band + MARGIN)


def within(pixels: Float[Tensor, "*batch 2"], frame: Float[Tensor, "2 2"]) -> Float[Tensor, "*batch 2"]:
    """Pixels moved into the frame: of a chord, the part that lies there stays within the box around its moved ends."""
    return pixels.clamp(frame[0], frame[1])
