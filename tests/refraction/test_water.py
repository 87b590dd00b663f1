"""The refractive index of water."""

import math

import pytest
import torch

from tests.tolerances import assert_matches
from torchrefrac.refraction import FRESH_WATER, SEA_WATER, water_index

COEFFICIENTS = (1.31405, 1.779e-4, -1.05e-6, 1.6e-8, -2.02e-6, 15.868, 0.01155, -0.00423, -4382.0, 1.1455e6)


@pytest.mark.parametrize(
    ("temperature", "published"), [(0.0, 1.33395), (10.0, 1.33369), (20.0, 1.33299), (30.0, 1.33192)]
)
def test_fresh_water_in_the_light_of_sodium_has_the_index_of_the_handbook(temperature, published):
    assert float(water_index(temperature, 0.0, 589.3)) == pytest.approx(published, abs=3e-5)


def test_the_open_ocean_at_twenty_degrees_has_the_published_index():
    assert float(water_index(20.0, 35.0, 589.3)) == pytest.approx(1.33940, abs=3e-5)


def test_the_formula_is_the_table_of_quan_and_fry(draw):
    t, s, w = draw.uniform(0.0, 30.0, 50), draw.uniform(0.0, 35.0, 50), draw.uniform(400.0, 700.0, 50)

    n0, n1, n2, n3, n4, n5, n6, n7, n8, n9 = COEFFICIENTS
    expected = n0 + (n1 + n2 * t + n3 * t**2) * s + n4 * t**2 + (n5 + n6 * s + n7 * t) / w + n8 / w**2 + n9 / w**3

    assert_matches(water_index(t, s, w), expected)


def test_the_presets_are_water_at_room_temperature():
    assert float(water_index()) == pytest.approx(FRESH_WATER, abs=1e-4)
    assert float(water_index(20.0, 35.0)) == pytest.approx(SEA_WATER, abs=1e-3)


def test_the_index_falls_with_temperature_and_wavelength_and_rises_with_salinity(draw):
    inputs = [draw.uniform(low, high, 1000) for low, high in ((0.1, 29.9), (0.1, 34.9), (401.0, 699.0))]
    for value in inputs:
        value.requires_grad_()

    by_temperature, by_salinity, by_wavelength = torch.autograd.grad(water_index(*inputs).sum(), inputs)

    assert (by_temperature < 0.0).all()
    assert (by_salinity > 0.0).all()
    assert (by_wavelength < 0.0).all()


def test_the_index_is_differentiable(draw):
    inputs = [draw.uniform(low, high, 3) for low, high in ((1.0, 29.0), (1.0, 34.0), (410.0, 690.0))]
    for value in inputs:
        value.requires_grad_()

    assert torch.autograd.gradcheck(water_index, inputs, check_forward_ad=True)


@pytest.mark.parametrize(
    ("name", "bad", "bounds"),
    [
        ("temperature_c", -0.1, "at least 0 and at most 30"),
        ("temperature_c", 30.1, "at least 0 and at most 30"),
        ("salinity_psu", -1.0, "at least 0 and at most 35"),
        ("salinity_psu", 36.0, "at least 0 and at most 35"),
        ("wavelength_nm", 0.589, "at least 400 and at most 700"),
        ("wavelength_nm", 701.0, "at least 400 and at most 700"),
        ("wavelength_nm", math.nan, "at least 400 and at most 700"),
    ],
)
def test_what_lies_outside_the_fit_is_refused_by_name(name, bad, bounds):
    with pytest.raises(ValueError, match=rf"^{name} is {bad:g}, but must be finite and {bounds}"):
        water_index(**{name: bad})
    with pytest.raises(ValueError, match=rf"^{name} is {bad:g} somewhere, but must be finite and {bounds}"):
        water_index(**{name: torch.tensor([bad])})


@pytest.mark.parametrize("name", ["temperature_c", "salinity_psu", "wavelength_nm"])
def test_an_integer_tensor_is_refused_by_name(name):
    whole = {"temperature_c": 20, "salinity_psu": 35, "wavelength_nm": 550}[name]

    with pytest.raises(ValueError, match=rf"^{name} has dtype torch.int64"):
        water_index(**{name: torch.tensor(whole)})


def test_arguments_broadcast_and_numbers_take_the_dtype_of_the_tensors():
    temperature, wavelength = torch.tensor([[0.0], [20.0]]), torch.tensor([450.0, 550.0, 650.0])

    index = water_index(temperature, 10.0, wavelength)

    assert index.shape == (2, 3)
    assert index.dtype == torch.float32
    assert_matches(index[1, 2], water_index(20.0, 10.0, 650.0).float())


def test_numbers_alone_give_a_scalar_in_double_precision():
    index = water_index(15.0, 35.0, 550.0)

    assert index.dtype == torch.float64
    assert index.shape == ()
