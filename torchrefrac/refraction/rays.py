"""Back projection: rays bent at flat layers (Chang & Chen, ICCV 2011, Eq. 6 to 9, for one water surface)."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchrefrac.geometry import triples
from torchrefrac.geometry.triples import Mask, Vectors
from torchrefrac.numerics import in_blocks
from torchrefrac.refraction.interface import FlatInterface, Parameter, parameter_dims, split_parameters


def refract_rays(
    center: Vectors, direction: Vectors, interface: FlatInterface
) -> tuple[Float[Tensor, "*batch 3"], Float[Tensor, "*batch 3"], Bool[Tensor, "*batch"]]:
    """Follow viewing rays through all layers of the interface, in its frame.

    center: on the camera's side; direction: in the camera's medium, of any length. Returns where the ray enters the
    last medium, its unit direction there, and a mask: False where the ray does not go towards the interface, is totally
    reflected on the way, or starts on the wrong side, and where the interface lies infinitely deep. There the ray is
    returned as it came, from the centre. Without refraction every ray that meets the plane is valid.
    """

    def refract(center: Vectors, direction: Vectors, *parameters: Parameter) -> tuple[Vectors, Vectors, Mask]:
        normal, offset, (first, *index), thickness = split_parameters(parameters)
        n, c = triples.split(normal), triples.split(center)
        v = triples.split(direction)
        length = triples.dot(v, v).sqrt()
        unit = triples.scaled(length.clamp(min=torch.finfo(length.dtype).tiny).reciprocal(), v)
        cosine, height = -triples.dot(unit, n), triples.dot(n, c) - offset
        valid = (cosine > 0) & (height > 0) & (height < torch.inf)
        cosine = torch.where(valid, cosine, 1.0)
        along = triples.add_scaled(unit, cosine, n)
        origin = triples.add_scaled(c, height / cosine, unit)
        origin = triples.add_scaled(origin, offset - triples.dot(n, origin), n)  # onto the surface to the last bit
        onward = cosine
        factor = torch.ones_like(cosine)
        for i, n_i in enumerate(index):
            factor = first / n_i
            cosine_sq = ((n_i - first) * (n_i + first) + (first * cosine).square()) / n_i.square()
            valid = valid & (cosine_sq > 0)
            onward = torch.where(cosine_sq > 0, cosine_sq, 1.0).sqrt()
            if i < len(thickness):
                origin = triples.add_scaled(origin, thickness[i] * factor / onward, along)
                origin = triples.add_scaled(origin, -thickness[i], n)
        bent = triples.add_scaled(triples.scaled(factor, along), -onward, n)
        return (
            torch.stack([torch.where(valid, o, c_k) for o, c_k in zip(origin, c, strict=True)], dim=-1),
            torch.stack([torch.where(valid, b, u) for b, u in zip(bent, unit, strict=True)], dim=-1),
            valid,
        )

    parameters = interface.parameters(direction)
    dims = (1, 1, *parameter_dims(parameters))
    center, direction, valid = in_blocks(refract, (center, direction, *parameters), dims, (1, 1, 0))
    return center, direction, valid
