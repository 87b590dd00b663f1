"""How much light a water surface mirrors."""

from jaxtyping import Float
from torch import Tensor


def reflectance(cosine: Float[Tensor, "*batch"], index_ratio: float) -> Float[Tensor, "*batch"]:
    """Share of unpolarised light that is mirrored where it comes from air with `cosine` of incidence.

    Fresnel's equations (Born & Wolf, Principles of Optics, section 1.5.2): the mean of both polarisations.
    """
    cosine = cosine.clamp(0.0, 1.0)
    in_water = (1.0 - (1.0 - cosine.square()) / index_ratio**2).sqrt()
    across = (cosine - index_ratio * in_water) / (cosine + index_ratio * in_water)
    along = (index_ratio * cosine - in_water) / (index_ratio * cosine + in_water)
    return 0.5 * (across.square() + along.square())
