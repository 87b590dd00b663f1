"""Neighbours that are found piece by piece are those of one tree of all."""

import pytest
import torch
from scipy.spatial import KDTree

from torchrefrac.dense import vicinity
from torchrefrac.dense.patches import Patches
from torchrefrac.dense.vicinity import NEAREST, REACH, vicinities

CELL = 2
FOOTPRINT = 0.01


@pytest.fixture
def patches(draw):
    """4000 on a bed of 4 by 1, with some far away from it."""
    points = torch.stack((draw.uniform(0.0, 4.0, 4000), draw.uniform(0.0, 1.0, 4000), 0.02 * draw.normal(4000)), dim=-1)
    points[::200] += torch.tensor([0.0, 3.0, 0.5], dtype=torch.float64)
    patches = Patches.room(4000, 2)
    patches.points[:] = points
    patches.footprint[:] = FOOTPRINT
    return patches


@pytest.mark.parametrize("piece", [100, 700, 10_000])
@pytest.mark.parametrize("step", [1, 3])
def test_pieces_have_the_neighbours_that_one_tree_finds(patches, monkeypatch, piece, step):
    monkeypatch.setattr(vicinity, "PIECE", piece)
    monkeypatch.setattr(vicinity, "AT_ONCE", 64)
    rows = torch.arange(0, len(patches), step)
    distance, index = KDTree(patches.points[rows].numpy()).query(patches.points[rows].numpy(), k=NEAREST + 1)
    wanted, near = torch.from_numpy(index[:, 1:]), torch.from_numpy(distance[:, 1:]) < REACH * CELL * FOOTPRINT

    met = torch.zeros(len(rows), dtype=torch.long)
    for around in vicinities(patches, rows, CELL):
        met[around.rows] += 1
        assert torch.equal(around.near, near[around.rows])
        assert torch.equal(around.others[around.near], wanted[around.rows][around.near])

    assert (met == 1).all()
    assert near.any(dim=1).double().mean() > 0.8
    assert not near.all()
