"""The refractive index of water."""

from typing import Final

from jaxtyping import Float
from torch import Tensor

from torchrefrac.checks import require
from torchrefrac.geometry.triples import Part
from torchrefrac.numerics import alike

FRESH_WATER: Final = 1.333
SEA_WATER: Final = 1.34
RANGES = {"temperature_c": (0.0, 30.0), "salinity_psu": (0.0, 35.0), "wavelength_nm": (400.0, 700.0)}


def water_index(
    temperature_c: Part | float = 20.0, salinity_psu: Part | float = 0.0, wavelength_nm: Part | float = 589.3
) -> Float[Tensor, "*batch"]:
    """Refractive index of water relative to air, n_water / n_air: Quan & Fry, Applied Optics 34(18), 1995, Eq. 3.

    temperature_c in degrees Celsius, 0 to 30; salinity_psu in practical salinity units (g/kg), 0 for fresh water, 35
    for the open ocean; wavelength_nm in air, 400 to 700 nm. The arguments broadcast; numbers alone give a float64
    scalar. Differentiable. Raises ValueError outside these ranges, which are those of the fit.
    """
    values = {"temperature_c": temperature_c, "salinity_psu": salinity_psu, "wavelength_nm": wavelength_nm}
    t, s, w = alike(**values)
    for name, value in values.items():
        low, high = RANGES[name]
        require(value, name, at_least=low, at_most=high)
    by_salinity = (1.779e-4 - 1.05e-6 * t + 1.6e-8 * t * t) * s
    by_wavelength = (15.868 + 0.01155 * s - 0.00423 * t) / w - 4382.0 / w**2 + 1.1455e6 / w**3
    return 1.31405 + by_salinity - 2.02e-6 * t * t + by_wavelength
