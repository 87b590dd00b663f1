"""What a level ray says about the water below it."""

from torch import Tensor


def slopes(rays: Tensor, index_ratio: Tensor) -> tuple[Tensor, Tensor]:
    """Horizontal slope in air m = v_xy / v_z (*B, 2), and the factor g (*B) by which water divides it.

    A point at p_z < 0 on the ray of a camera at height h lies at p_xy = -h m + p_z m / g from the camera
    (Chang & Chen, ICCV 2011, Eq. 9), g^2 = n^2 + (n^2 - 1) |m|^2.
    """
    slope = rays[..., :2] / rays[..., 2:]
    n_sq = index_ratio * index_ratio
    return slope, (n_sq + (n_sq - 1.0) * slope.square().sum(dim=-1)).sqrt()


def require_pairs(rays1: Tensor, rays2: Tensor, count: int, words: str) -> None:
    """Refuse anything but two batches (*B, count, 3) of finite rays; `words` name the solver."""
    if rays1.shape != rays2.shape or rays1.shape[-1:] != (3,):
        raise ValueError(f"rays1 {tuple(rays1.shape)} and rays2 {tuple(rays2.shape)} must both be (*B, {count}, 3)")
    if rays1.shape[-2] != count:
        raise ValueError(f"rays1 has {rays1.shape[-2]} rays, but the {words} takes exactly {count}")


def cross2(a: Tensor, b: Tensor) -> Tensor:
    """Two-dimensional cross product (*B) of (*B, 2) and (*B, 2)."""
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
