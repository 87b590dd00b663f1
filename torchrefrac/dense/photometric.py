"""How well patches agree with the images (Furukawa & Ponce, PAMI 2010, with refraction as Chang & Chen, section 3.6).

A patch is a plane along three rays of its reference image (see `window`), so that its window in the reference never
moves: f there is sampled once. In another image v the window is g_v(s), with s the patch's three numbers. With unit
vectors f^ and g^ (mean removed, norm 1),

    c_v = 1 - ZNCC(f, g_v) = |f^ - g^_v|^2 / 2,        cost = sum_v rho(c_v),   rho(c) = c / (1 + c / tau),

a sum of squares. With B = dg/ds (mean removed) and n = |g|, the derivative of f^ - g^ is -(B - g^ g^T B) / n: all that
the normal equations need are inner products of the five vectors B1, B2, B3, g, f. f^ and g have no mean, so that of B
matters in the products of B alone.
"""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchrefrac.camera import RefractiveCamera
from torchrefrac.dense.atlas import Atlas
from torchrefrac.dense.rays import PixelRays, project_moving
from torchrefrac.dense.window import Window
from torchrefrac.optim.batched import Quadratic

WORST = 2.0  # of 1 - ZNCC: what an image costs that does not see the patch
TINY = 1e-6  # squared norm of a window without any texture


class Agreement(NamedTuple):
    """ZNCC, and where it is usable; gradient and Hessian of c = 1 - ZNCC; motion: pixels by which the patch moves in
    the image per unit of its distance; for `change`, vectors: B1, B2, B3 and g, per_norm: 1 / n, and by_g: g^T B / n^2
    in states."""

    zncc: Float[Tensor, "n v"]
    usable: Bool[Tensor, "n v"]
    motion: Float[Tensor, "n v"]
    gradient: Float[Tensor, "n v 3"]
    hessian: Float[Tensor, "n v 3 3"]
    vectors: Float[Tensor, "n v 4 samples"]
    per_norm: Float[Tensor, "n v"]
    by_g: Float[Tensor, "n v 3"]

    def change(
        self, step: Float[Tensor, "n 3"], images: Bool[Tensor, "n v"], window: Window
    ) -> Float[Tensor, "n samples"]:
        """How the sum of g^ over some images changes as the states do by a step."""
        of_corners = (step @ window.basis.T.to(step))[:, None].expand(*images.shape, 3)
        of_g = -(self.by_g @ step[..., None])
        parts = torch.cat((of_corners, of_g), dim=-1) * (self.per_norm * images)[..., None]
        total = (parts.flatten(1)[:, None] @ self.vectors.flatten(1, 2))[:, 0]
        return total - total.mean(dim=-1, keepdim=True)


class Seen(NamedTuple):
    """Pixels of the corners of n patches in each image, their derivatives in the corners' own distances, and which
    patches are seen."""

    pixels: Float[Tensor, "n v 3 2"]
    along: Float[Tensor, "n v 3 2"]
    valid: Bool[Tensor, "n v"]


class Comparison(NamedTuple):
    """What n patches are compared with; nothing here changes while they are refined.

    cameras (m): of all images of the atlas; rays (n, 3): those of the window's three corners; reference: unit vectors
    f^; image, level: other images of the atlas, and which of their copies; present: which of these are to be looked at.
    """

    atlas: Atlas
    window: Window
    cameras: RefractiveCamera
    rays: PixelRays
    reference: Float[Tensor, "n samples"]
    image: Int[Tensor, "n v"]
    level: Int[Tensor, "n v"]
    present: Bool[Tensor, "n v"]
    tau: float

    def corners(self, states: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3 3"]:
        """The three corners of each patch in the world."""
        return self.rays.at(states @ self.window.basis.to(states).T)

    def at_matching_levels(self, seen: Seen, fresh: Bool[Tensor, " n"], min_scale: float) -> "Comparison":
        """For the `fresh` patches with the copies of the other images that show them about as large as the reference
        does. An image that shows one at less than `min_scale` of the reference's size is no longer present."""
        scale = _scale(seen.pixels, self.window)
        level = self.atlas.level_of(scale)
        changes = fresh[:, None]
        return self._replace(
            level=torch.where(changes, level, self.level), present=self.present & (~changes | (scale >= min_scale))
        )

    def model(self, agreement: Agreement) -> Quadratic:
        """Costs, gradients and Gauss-Newton Hessians in distance and two slopes."""
        bad = 1.0 - agreement.zncc
        share = 1.0 / (1.0 + bad / self.tau)
        weight = torch.where(agreement.usable, share.square(), 0.0)
        cost = torch.where(agreement.usable, bad * share, WORST / (1.0 + WORST / self.tau))
        like = self.rays.origin
        return Quadratic(
            torch.where(self.present, cost, 0.0).sum(dim=1).to(like),
            (weight[..., None] * agreement.gradient).sum(dim=1).to(like),
            (weight[..., None, None] * agreement.hessian).sum(dim=1).to(like),
        )

    def agreement(self, seen: Seen) -> Agreement:
        """ZNCC of patches in each image, where these see them, and its derivatives, exact for the sampled images."""
        shape, (pixels, along, valid) = self.image.shape, seen
        image, level = self.image.flatten(), self.level.flatten()
        window, like = self.window, self.reference
        basis, weights = window.basis.to(like), window.weights.T.to(like)
        at, along = pixels.to(like).flatten(0, 1), along.to(like).flatten(0, 1)
        corners, per_pixel = self.atlas.locate(image, level, at)
        places = (corners.flatten(1) @ window.places.to(like)).unflatten(1, (-1, 2))
        values, slopes = self.atlas.sample_with_slopes(places)
        across, down = slopes.mT.contiguous().split(1, dim=1)
        on_sheet = along * per_pixel
        vectors = like.new_empty(*shape, 4, weights.shape[1])
        moving, g = vectors.flatten(0, 1)[:, :3], vectors.flatten(0, 1)[:, 3]
        torch.mul(on_sheet[..., :1], across, out=moving)
        moving.addcmul_(on_sheet[..., 1:], down).mul_(weights)
        torch.sub(values, values.mean(dim=-1, keepdim=True), out=g)
        by_f = (vectors.flatten(1, 2) @ self.reference[..., None]).view(-1, 4)
        gram = vectors.flatten(0, 1) @ vectors.flatten(0, 1).mT
        sums = moving.sum(dim=-1)
        squares = gram[:, :3, :3].addcmul(sums[:, :, None], sums[:, None], value=-1.0 / weights.shape[1])
        norm_sq = gram[:, 3, 3]
        inside = self.atlas.contains(image, level, (at.flatten(1) @ window.outer.to(like)).unflatten(1, (-1, 2)))
        usable = valid.flatten() & (norm_sq > TINY) & inside
        per_norm = norm_sq.clamp(min=TINY).rsqrt()[:, None]
        zncc = by_f[:, 3:] * per_norm
        by_g = (gram[:, :3, 3] @ basis) * per_norm.square()
        hessian = squares.flatten(1) @ window.squared_basis.to(like) * per_norm.square()
        hessian = hessian.view(-1, 3, 3) - by_g[:, :, None] * by_g[:, None, :]
        return Agreement(
            zncc.view(shape),
            usable.view(shape) & self.present,
            along.mean(dim=1).norm(dim=-1).view(shape),
            (by_g * zncc - by_f[:, :3] @ basis * per_norm).view(*shape, 3),
            hessian.view(*shape, 3, 3),
            vectors,
            per_norm.view(shape),
            by_g.view(*shape, 3),
        )

    def project(self, states: Float[Tensor, "n 3"]) -> Seen:
        """Where each image sees the corners of the patches at states."""
        distances = states @ self.window.basis.to(states).T
        points, direction = self.rays.at(distances)[:, None], self.rays.direction_at(distances)[:, None]
        pixels, along, valid = project_moving(self.cameras[self.image[..., None]], points, direction)
        return Seen(pixels, along, valid.all(dim=-1))


def unit_windows(
    atlas: Atlas, image: Int[Tensor, " n"], level: Int[Tensor, " n"], pixels: Float[Tensor, "n 2"], window: Window
) -> tuple[Float[Tensor, "n samples"], Float[Tensor, " n"]]:
    """Unit vectors f^ of the windows around pixels, and their standard deviations in grey levels. Zero where a window
    does not lie inside its image, in the copy `level`."""
    at = pixels[:, None] + window.offsets.to(pixels)
    values = atlas.sample(image, level, at.to(atlas.sheet))
    values = values - values.mean(dim=-1, keepdim=True)
    values = torch.where(atlas.contains(image, level, at[:, [0, -1]])[:, None], values, 0.0)
    norm_sq = values.square().sum(dim=-1)
    return values * norm_sq.clamp(min=TINY).rsqrt()[:, None], (norm_sq / values.shape[1]).sqrt()


def patch_costs(
    cameras: RefractiveCamera,
    images: Sequence[Float[Tensor, "_ _"]] | Atlas,
    reference: Int[Tensor, " n"],
    pixels: Float[Tensor, "n 2"],
    states: Float[Tensor, "n 3"],
    others: Int[Tensor, "n v"],
    window: Window | None = None,
    tau: float = 0.3,
) -> Float[Tensor, " n"]:
    """The costs of patches, as plain differentiable operations: a loss for learning and for joint adjustment.

    cameras (m) with their images, grey; reference and others: indices of images; pixels: of the patches' centres in
    their reference images; states: distance along the ray from the water surface, in the length unit of the cameras,
    and how much it grows towards +x and +y over `window.radius` pixels. Differentiable in all of the cameras (poses,
    intrinsics, interface), the images, the pixels and the states. An image that does not see a patch as a whole, or
    sees no texture there, costs a constant.
    """
    window = Window() if window is None else window
    atlas = images if isinstance(images, Atlas) else Atlas.build(images, levels=1)
    rays = PixelRays.cast(cameras[reference][:, None], pixels[:, None] + window.corners.to(pixels))
    f, _ = unit_windows(atlas, reference, torch.zeros_like(reference), pixels, window)
    zncc, usable, _ = correlations(cameras, atlas, rays, f, states, others, window)
    bad = torch.where(usable, 1.0 - zncc, WORST)
    return (bad / (1.0 + bad / tau)).sum(dim=-1)


def correlations(
    cameras: RefractiveCamera,
    atlas: Atlas,
    rays: PixelRays,
    f: Float[Tensor, "n samples"],
    states: Float[Tensor, "n 3"],
    others: Int[Tensor, "n v"],
    window: Window,
    matching_levels: bool = False,
) -> tuple[Float[Tensor, "n v"], Bool[Tensor, "n v"], Float[Tensor, "n v"]]:
    """ZNCC of patches in other images, as plain differentiable operations; where these show them as a whole, with
    texture; and the scale at which they do, against the reference.

    rays (n, 3): those of the window's corners; f: unit vectors of the windows. matching_levels: looks at the copies
    that show the patches about as large as the reference does.
    """
    points = rays.at(states @ window.basis.to(states).T)
    seen, valid = cameras[others][..., None].project(points[:, None])
    scale = _scale(seen, window)
    flat, seen = others.flatten(), seen.flatten(0, 1).to(torch.promote_types(f.dtype, atlas.sheet.dtype))
    level = atlas.level_of(scale).flatten() if matching_levels else torch.zeros_like(flat)
    at = (seen.flatten(1) @ window.places.to(seen)).unflatten(1, (-1, 2))
    g = atlas.sample(flat, level, at).view(*others.shape, -1)
    g = g - g.mean(dim=-1, keepdim=True)
    norm_sq = g.square().sum(dim=-1)
    usable = valid.all(dim=-1) & (norm_sq > TINY) & atlas.contains(flat, level, at).view(others.shape)
    return (f[:, None] * g).sum(dim=-1) * norm_sq.clamp(min=TINY).rsqrt(), usable, scale


def _scale(corners: Float[Tensor, "*batch 3 2"], window: Window) -> Float[Tensor, "*batch"]:
    """Of windows with these corners, against the reference's."""
    return (_area(corners).abs() / _area(window.corners).to(corners)).sqrt()


def _area(corners: Float[Tensor, "*batch 3 2"]) -> Float[Tensor, "*batch"]:
    """Twice the signed area of triangles."""
    a, b = corners[..., 1, :] - corners[..., 0, :], corners[..., 2, :] - corners[..., 0, :]
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
