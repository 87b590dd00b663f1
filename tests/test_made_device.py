"""The device that tests make instead of a GPU."""

import pytest
import torch

from tests.made_device import LOOKS, MADE, SIZES, UPLOADS, MixedDevicesError, waits, without_waiting


@pytest.fixture
def row():
    return torch.tensor([3.0, 1.0, 2.0], dtype=torch.float64).to("made")


def test_what_is_made_of_tensors_there_is_there(row):
    for made in (row + 1.0, row.new_zeros(2), torch.arange(3, device=row.device), row[None].mT, row[row > 1.5]):
        assert made.device == MADE
    assert row.cpu().device == torch.device("cpu")
    assert (2.0 * row).tolist() == [6.0, 2.0, 4.0]


@pytest.mark.parametrize(
    "mix",
    [
        lambda row: row + torch.ones(3),
        lambda row: row @ torch.ones(3, dtype=torch.float64),
        lambda row: row[torch.tensor([0])],
        lambda row: torch.zeros(3)[row.long()],
        lambda row: torch.cat((row, torch.ones(1))),
        lambda row: row.index_fill_(0, torch.tensor([1]), 0.0),
        lambda row: torch.randn(3, device=row.device, generator=torch.Generator()),
    ],
)
def test_devices_are_not_mixed(row, mix):
    with pytest.raises(MixedDevicesError):
        mix(row)


def test_numbers_without_dimensions_may_come_from_the_cpu_and_arrays_of_numpy_may_not_be_taken(row):
    for twice in (row * torch.tensor(2.0), torch.tensor(2.0) * row):
        assert twice.device == MADE
        assert twice.tolist() == [6.0, 2.0, 4.0]
    with pytest.raises(RuntimeError):
        row.numpy()


def test_what_is_written_to_a_view_or_to_an_output_stands_in_the_whole(row):
    table = row.new_zeros(2, 3)

    table[0, :2] = 5.0
    torch.add(row, row, out=table[1])
    same = table.mul_(2.0)

    assert same is table
    assert table.tolist() == [[10.0, 10.0, 0.0], [12.0, 4.0, 8.0]]


def test_it_counts_for_what_the_host_waits(row):
    with waits() as counted:
        float(row[0])
        row.tolist()
        row[row > 1.5]
        torch.unique(row)
        row.new_tensor([1.0, 2.0])
        torch.linalg.eigh(row.diag())
        row[row > 1.5] = 0.0

    assert counted == {LOOKS: 3, SIZES: 2, UPLOADS: 1}
    with without_waiting("made"):
        (row.cumsum(dim=0) * row.new_full((), 2.0)).sort()


class Doubled(torch.autograd.Function):
    @staticmethod
    def forward(ctx, x):
        ctx.save_for_backward(x)
        return x * x

    @staticmethod
    def backward(ctx, slope):
        (x,) = ctx.saved_tensors
        return 2.0 * x * slope


def test_derivatives_are_those_of_the_cpu(row):
    leaf = row.clone().requires_grad_()

    Doubled.apply(leaf).sum().backward()

    assert leaf.grad is not None
    assert leaf.grad.device == MADE
    assert leaf.grad.tolist() == [6.0, 2.0, 4.0]
    for derivative in (torch.func.jacrev, torch.func.jacfwd):
        assert derivative(lambda x: x.sin())(row).diagonal().tolist() == row.cpu().cos().tolist()
    assert torch.func.vmap(lambda x: x + 1.0)(row).tolist() == [4.0, 2.0, 3.0]
