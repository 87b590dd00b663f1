"""The refrax ratio of one water surface (Chang & Chen, ICCV 2011, section 3.2)."""

from jaxtyping import Float
from torch import Tensor

from torchrefrac.checks import require
from torchrefrac.geometry.triples import Part
from torchrefrac.numerics import alike, in_blocks
from torchrefrac.refraction.layers import METHODS, Method, apparent_slope


def solve_refrax(
    height: Part | float,
    depth: Part | float,
    distance: Part | float,
    index_ratio: Part | float,
    method: Method = "halley",
) -> Float[Tensor, "*batch"]:
    """Refrax ratio lambda in (0, 1]: horizontal (camera to refrax) / (camera to point).

    height > 0: camera above the water; depth >= 0: point below the water; distance >= 0: horizontal, all in
    one unit of length; index_ratio >= 1: n_water / n_air. The arguments broadcast; half precision is raised to
    float32. For depth/height within 10^+-3, up to 89.9 degrees of incidence and index ratios up to 2.5 the relative
    error stays below 1e-13 in float64 and 1e-5 in float32.

    Differentiable in all four, twice, at nadir (distance 0) and index ratio 1 too; the derivatives are those of the
    implicit function theorem whatever the method. Works under `torch.func` (vmap, jacrev, jacfwd), autocast and
    `torch.compile(fullgraph=True)`. "halley" is the fast method, "newton" the simple one, "companion" finds the
    eigenvalues of the paper's quartic (Eq. 4, its constant term with the right sign) and is the oracle.
    Raises ValueError for arguments outside these ranges (compiled code cannot look) or shapes that do not broadcast.
    """
    if method not in METHODS:
        raise ValueError(f"method is {method!r}, but must be one of {', '.join(METHODS)}")
    values = alike(height=height, depth=depth, distance=distance, index_ratio=index_ratio)
    require(height, "height", above=0.0)
    require(depth, "depth", at_least=0.0)
    require(distance, "distance", at_least=0.0)
    require(index_ratio, "index_ratio", at_least=1.0)

    def solve(h: Part, d: Part, a: Part, n: Part) -> tuple[Part]:
        return (h * apparent_slope(a * a, h, (d,), (n,), method),)

    return in_blocks(solve, values, event_dims=(0, 0, 0, 0), result_dims=(0,))[0]
