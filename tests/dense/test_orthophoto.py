"""The surface in colour: photographs that are made by casting rays onto it must give back what it is painted with."""

from dataclasses import replace

import pytest
import torch

from tests.dense.flights import BED, paint
from tests.files.rasters import raster_of
from torchrefrac.dense.images import Images
from torchrefrac.dense.orthophoto import _Cells, _hiding, _seen, _sides, orthophoto
from torchrefrac.scene import Interfaces


def _bed(cell_size=0.1):
    return raster_of(torch.full((60, 90), BED, dtype=torch.float64), x_west=-4.5, y_north=3.0, cell_size=cell_size)


def _truth(raster):
    y, x = torch.meshgrid(raster.y, raster.x, indexing="ij")
    return paint(torch.stack((x.flatten(), y.flatten()), dim=-1)).view(*x.shape, 3)


def test_colours_stand_where_they_are_on_the_bed(flight):
    scene = flight((1.0, 1.0, 1.0))

    found = orthophoto(_bed(), scene, Images(scene.capture), fine=False)

    error = (found.colors.double() - _truth(found)).abs()
    assert float(error.max()) < 3.0
    assert float(error.mean()) < 1.0


def test_without_refraction_they_would_not(flight):
    scene = flight((1.0, 1.0, 1.0))

    found = orthophoto(_bed(), replace(scene, interfaces=Interfaces.level(1.0)), Images(scene.capture), fine=False)

    assert float((found.colors.double() - _truth(found)).abs().mean()) > 3.0


def test_photographs_of_other_exposures_leave_no_seam(flight):
    scene = flight((1.0, 0.7, 1.2))

    found = orthophoto(_bed(), scene, Images(scene.capture), fine=False)

    truth = _truth(found)
    gain = (found.colors.double() / truth).median()
    assert float((found.colors.double() / gain - truth).abs().mean()) < 1.5


def test_cells_are_as_fine_as_pixels_where_that_is_asked_for(flight):
    scene = flight((1.0, 1.0, 1.0))

    found = orthophoto(_bed(0.1), scene, Images(scene.capture))

    assert found.cell_size == pytest.approx(0.05)  # a pixel reaches 0.067 m
    coarse = raster_of(torch.full((15, 22), BED, dtype=torch.float64), x_west=-4.4, y_north=3.0, cell_size=0.4)
    finer = orthophoto(coarse, scene, Images(scene.capture))
    assert (finer.colors.shape, finer.cell_size) == ((90, 132, 3), pytest.approx(0.4 / 6))
    assert float((finer.colors.double() - _truth(finer)).abs().mean()) < 1.0


def test_what_stands_higher_hides_what_lies_behind_it(flight):
    """A wall of 1.5 m hides the bed beside it from the camera on the other side."""
    scene = flight((1.0, 1.0, 1.0))
    bed = _bed()
    high = replace(bed, height=torch.where((bed.x > 0.9) & (bed.x < 1.1), -0.5, bed.height))
    cells, camera = _Cells.of(high), scene.camera_of(0)

    solid = torch.cat((cells.points, _sides(high)))
    _, weight = _seen(cells, camera, 0, Images(scene.capture), _hiding(solid, high.cell_size, camera))

    x = cells.points[:, 0]
    assert not bool(weight[(x > 1.1) & (x < 1.25)].any())
    assert bool((weight[(x > 0.9) & (x < 1.1)] > 0.0).all())
    assert bool((weight[(x > 2.0) & (x < 2.5)] > 0.0).all())


def test_sides_stand_at_the_edges_of_what_is_higher():
    block = torch.full((4, 4), -2.0, dtype=torch.float64)
    block[1, 2] = 1.5

    sides = _sides(raster_of(block, y_north=4.0))

    assert sorted({tuple(point[:2]) for point in sides.tolist()}) == [(2.0, 2.5), (2.5, 2.0), (2.5, 3.0), (3.0, 2.5)]
    assert sorted({point[2] for point in sides.tolist()}) == [-1.5, -0.5, 0.5]
    assert len(sides) == 12
