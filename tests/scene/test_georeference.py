"""From the frame of a scene onto a map."""

import pytest
import torch

from torchrefrac.geometry import so3_exp
from torchrefrac.scene import Georeference, Interfaces


def test_lengths_along_the_map_are_scaled_and_heights_are_not():
    place = Georeference("EPSG:32633", (412_345.0, 5_312_345.0, 400.0), scale=0.9996)
    points = torch.tensor([[0.0, 0.0, 0.0], [1000.0, -500.0, -3.0]], dtype=torch.float64)

    found = place.raised(31.0).coordinates(points)

    assert found[0].tolist() == [412_345.0, 5_312_345.0, 431.0]
    assert found[1].tolist() == pytest.approx([413_344.6, 5_311_845.2, 428.0], abs=1e-9)


def test_a_frame_in_which_the_water_of_a_river_is_level_is_turned_the_shortest_way(draw):
    place = Georeference("EPSG:32633", (412_345.0, 5_312_345.0, 400.0), scale=0.9996).raised(31.0, (0.02, -0.01))
    points = 50.0 * draw.normal(6, 3)

    found = place.coordinates(points)

    normal = torch.nn.functional.normalize(torch.tensor((-0.02, 0.01, 1.0)).double(), dim=0)
    axis = torch.linalg.cross(torch.tensor((0.0, 0.0, 1.0)).double(), normal)
    turn = so3_exp(axis / axis.norm() * normal[2].acos())
    wanted = points @ turn.mT * torch.tensor((0.9996, 0.9996, 1.0)) + torch.tensor((412_345.0, 5_312_345.0, 431.0))
    torch.testing.assert_close(found, wanted.double(), rtol=0.0, atol=1e-6)
    torch.testing.assert_close(place.local(found), points, rtol=0.0, atol=1e-6)
    in_water = place.coordinates(points * torch.tensor((1.0, 1.0, 0.0)))
    torch.testing.assert_close(place.water_heights(*in_water[:, :2].T), in_water[:, 2], rtol=0.0, atol=1e-6)
    assert float(place.water.signed_distance(in_water).abs().max()) < 1e-6
    assert float((place.water.normal_like(points)[:2] * 0.9996 - normal[:2]).abs().max()) < 1e-5


def test_level_water_has_its_height_to_the_last_bit():
    place = Georeference("EPSG:32633", (412_345.0, 5_312_345.0, 430.97))

    assert place.water.normal == (0.0, 0.0, 1.0)
    assert str(place.water.normal) == "(0.0, 0.0, 1.0)"
    assert Interfaces.of_plane(place.water, 1.33).offset.tolist() == [430.97]
    assert torch.equal(place.level_from_local, torch.eye(3).double())


def test_its_name_has_the_datum_of_heights_where_that_has_a_code():
    assert Georeference("EPSG:32633", (0.0, 0.0, 0.0), "EPSG:5773").name == "EPSG:32633+5773"
    assert Georeference("EPSG:32633", (0.0, 0.0, 0.0), "ellipsoid").name == "EPSG:32633"
    assert Georeference("EPSG:32633", (0.0, 0.0, 0.0)).name == "EPSG:32633"
