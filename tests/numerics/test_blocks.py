"""Work on long batches, block by block."""

import pytest
import torch

from torchrefrac.numerics import in_blocks
from torchrefrac.numerics.blocks import BLOCK

SHAPES = [  # batch of a vector, a number and a mask
    ((), (), ()),
    ((50,), (), (50,)),
    ((7, 1), (1, 9), ()),
    ((9,), (7, 1), (1,)),
    ((2, 3, 4, 5), (5,), (3, 1, 1)),
    ((30, 1, 1), (1, 2, 1), (1, 1, 3)),
    ((1, 40), (1, 1), (40,)),
    ((0,), (), (0,)),
    ((5, 0, 3), (1,), (3,)),
    ((0, 5), (5,), ()),
]


@pytest.mark.parametrize("size", [1, 7, 40, 1000])
@pytest.mark.parametrize("shapes", SHAPES, ids=str)
def test_the_blocks_together_are_the_whole(draw, shapes, size):
    tensors = _tensors(draw, shapes)

    results = in_blocks(_function, tensors, (1, 0, 0), (1, 0, 2), size)

    for result, whole in zip(results, _function(*tensors), strict=True):
        assert result.shape == whole.shape
        assert result.dtype == whole.dtype
        assert torch.equal(result, whole)


@pytest.mark.parametrize("size", [3, 1000])
def test_a_result_that_does_not_depend_on_all_of_the_batch_is_spread_over_it(draw, size):
    vector, number = draw.normal(4, 1, 3), draw.normal(5)

    norm, doubled = in_blocks(lambda v, x: (v.norm(dim=-1), 2.0 * x), (vector, number), (1, 0), (0, 0), size)

    assert torch.equal(norm, vector.norm(dim=-1).expand(4, 5))
    assert torch.equal(doubled, (2.0 * number).expand(4, 5))


def test_no_block_is_longer_than_its_size(draw):
    for shapes in SHAPES:
        for count in _lengths_of_blocks(_tensors(draw, shapes), size=7):
            assert count <= 7


def test_a_long_batch_is_split_and_a_short_one_is_not(draw):
    assert _lengths_of_blocks(_tensors(draw, ((BLOCK,), (), ()))) == [BLOCK]
    assert _lengths_of_blocks(_tensors(draw, ((BLOCK + 1,), (), ()))) == [BLOCK, 1]


def test_the_order_of_memory_does_not_matter(draw):
    vector, number = draw.normal(3, 20, 30).permute(2, 1, 0), draw.normal(20, 30).T

    results = in_blocks(_function, (vector, number, number > 0.0), (1, 0, 0), (1, 0, 2), 16)

    for result, whole in zip(results, _function(vector, number, number > 0.0), strict=True):
        assert torch.equal(result, whole)


def test_what_autograd_follows_is_one_block(draw):
    vector, number, mask = _tensors(draw, ((20,), (), (20,)))

    assert _lengths_of_blocks((vector.requires_grad_(), number, mask), size=7) == [20]
    with torch.no_grad():
        assert len(_lengths_of_blocks((vector, number, mask), size=7)) == 3


def test_what_a_transform_holds_is_one_block(draw):
    vector, number, mask = _tensors(draw, ((20,), (), (20,)))
    lengths = []

    def per_scale(scale):
        lengths.extend(_lengths_of_blocks((vector, number * scale, mask), size=7))
        return scale

    torch.func.vmap(per_scale)(torch.ones(2))

    assert lengths == [20]


def test_the_gradient_through_a_long_batch_is_that_of_the_function(draw):
    vector, number, mask = _tensors(draw, ((20,), (), (20,)))
    inputs = (vector.requires_grad_(), number.requires_grad_())

    blocks = in_blocks(_function, (*inputs, mask), (1, 0, 0), (1, 0, 2), 7)
    gradients = torch.autograd.grad(sum(result.sum() for result in blocks), inputs)

    whole = torch.autograd.grad(sum(result.sum() for result in _function(*inputs, mask)), inputs)
    for gradient, expected in zip(gradients, whole, strict=True):
        assert torch.equal(gradient, expected)


def _function(vector, number, mask):
    """A vector, a number and a matrix for every element of the batch."""
    scaled = torch.where(mask[..., None], number[..., None] * vector, vector)
    length = scaled.square().sum(dim=-1)
    return scaled, torch.where(mask, length, number), scaled[..., :, None] * scaled[..., None, :]


def _tensors(draw, shapes):
    vectors, numbers, masks = shapes
    return draw.normal(*vectors, 3), draw.normal(*numbers), draw.normal(*masks) > 0.0


def _lengths_of_blocks(tensors, **size):
    lengths = []

    def watch(vector, number, mask):
        result = _function(vector, number, mask)
        lengths.append(result[1].numel())
        return result

    in_blocks(watch, tensors, (1, 0, 0), (1, 0, 2), **size)
    return lengths
