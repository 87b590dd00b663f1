"""From the frame of a scene onto a map."""

import pytest
import torch

from torchrefrac.scene import Georeference


def test_lengths_along_the_map_are_scaled_and_heights_are_not():
    place = Georeference("EPSG:32633", (412_345.0, 5_312_345.0, 400.0), scale=0.9996)
    points = torch.tensor([[0.0, 0.0, 0.0], [1000.0, -500.0, -3.0]], dtype=torch.float64)

    found = place.raised(31.0).coordinates(points)

    assert found[0].tolist() == [412_345.0, 5_312_345.0, 431.0]
    assert found[1].tolist() == pytest.approx([413_344.6, 5_311_845.2, 428.0], abs=1e-9)


def test_its_name_has_the_datum_of_heights_where_that_has_a_code():
    assert Georeference("EPSG:32633", (0.0, 0.0, 0.0), "EPSG:5773").name == "EPSG:32633+5773"
    assert Georeference("EPSG:32633", (0.0, 0.0, 0.0), "ellipsoid").name == "EPSG:32633"
    assert Georeference("EPSG:32633", (0.0, 0.0, 0.0)).name == "EPSG:32633"
