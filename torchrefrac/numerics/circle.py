"""Linear least squares in two unknowns on the unit circle (LSQI, Golub & Van Loan, section 6.2.1)."""

import torch
from jaxtyping import Float
from torch import Tensor

SECULAR_ITERATIONS = 30


def least_squares_on_circle(
    gram: Float[Tensor, "*batch 2 2"], rhs: Float[Tensor, "*batch 2"]
) -> Float[Tensor, "*batch 2"]:
    """The unit vector y that minimises y^T G y - 2 g^T y, for G = `gram` and g = `rhs`.

    With G = A^T A and g = A^T b this is min |A y - b| on |y| = 1. Lagrange: (G + mu I) y = g. In the
    eigenbasis of G (values l_1 <= l_2, g = (b_1, b_2)) the secular equation sum (b_i / (l_i + mu))^2 = 1 has
    one root with mu > -l_1, and it is the global minimum. Newton on 1/|y| = 1 climbs to it monotonically in
    shift = mu + l_1 (which keeps its digits near zero) from max(|b_i| - l_i) + l_1, where one term alone reaches 1.
    If b_1 = 0 and the root is lost (the "hard case"), both signs of the remaining component are optimal and
    the positive one is returned.
    """
    values, vectors = torch.linalg.eigh(gram)
    b = (vectors.mT @ rhs[..., None])[..., 0]
    tiny = torch.finfo(gram.dtype).tiny ** 0.5
    above = values - values[..., :1]
    shift = (b.abs() - above).amax(dim=-1, keepdim=True)
    for _ in range(SECULAR_ITERATIONS):
        gap = (above + shift).clamp(min=tiny)
        y = b / gap
        norm = y.norm(dim=-1, keepdim=True).clamp(min=tiny)
        slope = (y * y / gap).sum(dim=-1, keepdim=True).clamp(min=tiny)
        shift = shift + (norm - 1.0).clamp(min=0.0) * norm * norm / slope
    y = b / (above + shift).clamp(min=tiny)
    lost = y.norm(dim=-1, keepdim=True) < 1.0 - 64.0 * torch.finfo(gram.dtype).eps
    missing = (1.0 - y[..., 1:].square()).clamp(min=0.0).sqrt()
    y = torch.where(lost, torch.cat((missing, y[..., 1:]), dim=-1), y)
    y = y / y.norm(dim=-1, keepdim=True)
    return (vectors @ y[..., None])[..., 0]
