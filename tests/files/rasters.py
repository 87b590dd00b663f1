"""A raster of given heights."""

import torch

from torchrefrac.scene import Raster


def raster_of(height, valid=None, *, x_west=0.0, y_north=0.0, cell_size=1.0):
    """(rows, columns) heights in m, by default of a surface everywhere, black and exact."""
    valid = torch.ones_like(height, dtype=torch.bool) if valid is None else valid
    return Raster(
        height=height * valid,
        sigma=torch.zeros_like(height),
        count=valid.long(),
        colors=torch.zeros(*height.shape, 3, dtype=torch.uint8),
        valid=valid,
        filled=torch.zeros_like(valid),
        x_west=x_west,
        y_north=y_north,
        cell_size=cell_size,
        length_unit="m",
        views=torch.zeros_like(height),
    )
