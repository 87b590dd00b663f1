"""Tensors in files that nobody sees."""

import pytest
import torch

from torchrefrac.files.mapped import mapped


@pytest.mark.parametrize("dtype", [torch.float64, torch.long, torch.bool])
@pytest.mark.parametrize("shape", [(3,), (4, 2), (0, 5)])
def test_a_mapped_tensor_begins_with_zeros_and_can_be_written(tmp_path, dtype, shape):
    tensor = mapped(shape, dtype, tmp_path / "new")

    assert (tensor.shape, tensor.dtype) == (shape, dtype)
    assert not tensor.any()
    tensor[:1] = 1
    assert tensor.sum() == tensor[:1].numel()
    assert not list(tmp_path.glob("new/*"))
