"""How well patches agree with the images (Furukawa & Ponce, PAMI 2010, with refraction as Chang & Chen, section 3.6).

A patch is a plane along three rays of its reference image (see `window`), so that its window in the reference never
moves: f there is sampled once. In another image v the window is g_v(s), with s the patch's three numbers. With unit
vectors f^ and g^ (mean removed, norm 1),

    c_v = 1 - ZNCC(f, g_v) = |f^ - g^_v|^2 / 2,        cost = sum_v rho(c_v),   rho(c) = c / (1 + c / tau),

a sum of squares. With B = dg/ds (mean removed) and n = |g|, the derivative of f^ - g^ is -(B - g^ g^T B) / n: all that
the normal equations need are inner products of the five vectors B1, B2, B3, g, f.
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
    the image per unit of its distance; rows, where asked for: derivatives of g^, each state's."""

    zncc: Float[Tensor, "n v"]
    usable: Bool[Tensor, "n v"]
    motion: Float[Tensor, "n v"]
    gradient: Float[Tensor, "n v 3"]
    hessian: Float[Tensor, "n v 3 3"]
    rows: Float[Tensor, "n v 3 samples"] | None


class Comparison(NamedTuple):
    """What n patches are compared with; nothing here changes while they are refined.

    rays (n, 3): those of the window's three corners; reference: unit vectors f^; image, level: other images of the
    atlas, and which of their copies; cameras (n, v, 1): theirs; present: which of these are to be looked at.
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

    def subset(self, rows: Int[Tensor, " k"]) -> "Comparison":
        """Some of the patches."""
        of_patches = ("cameras", "rays", "reference", "image", "level", "present")
        return self._replace(**{name: getattr(self, name)[rows] for name in of_patches})

    def corners(self, states: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3 3"]:
        """The three corners of each patch in the world."""
        return self.rays.at(states @ self.window.basis.to(states).T)

    def at_matching_levels(self, states: Float[Tensor, "n 3"], min_scale: float) -> "Comparison":
        """With the copies of the other images that show the patches about as large as the reference does. An image that
        shows one at less than `min_scale` of the reference's size is no longer present."""
        pixels, _, _ = self._project(states)
        scale = (_area(pixels).abs() / _area(self.window.corners).to(pixels)).sqrt()
        level = torch.log2(scale.clamp(min=1.0)).round().long().clamp(max=self.atlas.levels - 1)
        return self._replace(level=level, present=self.present & (scale >= min_scale))

    def linearize(self, states: Float[Tensor, "n 3"]) -> Quadratic:
        """Costs, gradients and Gauss-Newton Hessians at states: distance and two slopes."""
        agreement = self.agreement(states)
        bad = 1.0 - agreement.zncc
        share = 1.0 / (1.0 + bad / self.tau)
        weight = torch.where(agreement.usable, share.square(), 0.0)
        cost = torch.where(agreement.usable, bad * share, WORST / (1.0 + WORST / self.tau))
        return Quadratic(
            torch.where(self.present, cost, 0.0).sum(dim=1).to(states),
            (weight[..., None] * agreement.gradient).sum(dim=1).to(states),
            (weight[..., None, None] * agreement.hessian).sum(dim=1).to(states),
        )

    def agreement(self, states: Float[Tensor, "n 3"], with_rows: bool = False) -> Agreement:
        """ZNCC of the patches at states in each image and its derivatives, exact for the sampled images."""
        shape = self.image.shape
        image, level = self.image.flatten(), self.level.flatten()
        basis, weights = self.window.basis.to(states), self.window.weights.to(self.reference)
        pixels, along, valid = self._project(states)
        at, along = pixels.to(weights).flatten(0, 1), along.flatten(0, 1)
        places = (at.flatten(1) @ self.window.places.to(weights)).unflatten(1, (-1, 2))
        values, slopes = self.atlas.sample_with_slopes(image, level, places)
        vectors = weights.new_empty(len(image), 5, weights.shape[0])
        torch.mul(along.to(weights) @ slopes.mT, weights.T, out=vectors[:, :3])
        vectors[:, 3] = values
        vectors[:, 4] = self.reference.repeat_interleave(shape[1], dim=0)
        vectors -= vectors.mean(dim=-1, keepdim=True)
        gram = vectors @ vectors.mT
        norm_sq = gram[:, 3, 3]
        usable = valid.flatten() & (norm_sq > TINY) & self.atlas.contains(image, level, self.window.outer.to(at) @ at)
        per_norm = norm_sq.clamp(min=TINY).rsqrt()[:, None]
        to_state = basis.to(weights).T
        by_f = (gram[:, :3, 4] @ to_state.T) * per_norm
        by_g = (gram[:, :3, 3] @ to_state.T) * per_norm.square()
        squares = (to_state @ gram[:, :3, :3] @ to_state.T) * per_norm.square()[..., None]
        zncc = gram[:, 3, 4] * per_norm[:, 0]
        rows = None
        if with_rows:
            by_values = to_state @ vectors[:, :3] - by_g[:, :, None] * vectors[:, 3:4]
            rows = (by_values * per_norm[..., None]).view(*shape, 3, weights.shape[0])
        return Agreement(
            zncc.view(shape),
            usable.view(shape) & self.present,
            along.mean(dim=1).norm(dim=-1).view(shape),
            (by_g * zncc[:, None] - by_f).view(*shape, 3),
            (squares - by_g[:, :, None] * by_g[:, None, :]).view(*shape, 3, 3),
            rows,
        )

    def _project(
        self, states: Float[Tensor, "n 3"]
    ) -> tuple[Float[Tensor, "n v 3 2"], Float[Tensor, "n v 3 2"], Bool[Tensor, "n v"]]:
        """Pixels of the corners in each image, their derivatives in their own distances, and which patches are seen."""
        distances = states @ self.window.basis.to(states).T
        points, direction = self.rays.at(distances)[:, None], self.rays.direction_at(distances)[:, None]
        pixels, along, valid = project_moving(self.cameras, points, direction)
        return pixels, along, valid.all(dim=-1)


def unit_windows(
    atlas: Atlas, image: Int[Tensor, " n"], level: Int[Tensor, " n"], pixels: Float[Tensor, "n 2"], window: Window
) -> tuple[Float[Tensor, "n samples"], Float[Tensor, " n"]]:
    """Unit vectors f^ of the windows around pixels, and their standard deviations in grey levels. Zero where a window
    does not lie inside its image, in the copy `level`."""
    at = pixels[:, None] + window.offsets.to(pixels)
    values = atlas.sample(image, level, at.to(atlas.sheet))
    values = values - values.mean(dim=-1, keepdim=True)
    values = torch.where(atlas.contains(image, level, at)[:, None], values, 0.0)
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
    count, views = others.shape
    corners = pixels[:, None] + window.corners.to(pixels)
    rays = PixelRays.cast(cameras[reference][:, None], corners)
    points = rays.at(states @ window.basis.to(states).T)
    seen, valid = cameras[others][..., None].project(points[:, None])
    flat, at = others.flatten(), window.weights.to(seen) @ seen.flatten(0, 1)
    level = torch.zeros_like(flat)
    f, _ = unit_windows(atlas, reference, torch.zeros_like(reference), pixels, window)
    g = atlas.sample(flat, level, at).view(count, views, -1)
    g = g - g.mean(dim=-1, keepdim=True)
    norm_sq = g.square().sum(dim=-1)
    usable = valid.all(dim=-1) & (norm_sq > TINY) & atlas.contains(flat, level, at).view(count, views)
    zncc = (f[:, None] * g).sum(dim=-1) * norm_sq.clamp(min=TINY).rsqrt()
    bad = torch.where(usable, 1.0 - zncc, WORST)
    return (bad / (1.0 + bad / tau)).sum(dim=-1)


def _area(corners: Float[Tensor, "*batch 3 2"]) -> Float[Tensor, "*batch"]:
    """Twice the signed area of triangles."""
    a, b = corners[..., 1, :] - corners[..., 0, :], corners[..., 2, :] - corners[..., 0, :]
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
