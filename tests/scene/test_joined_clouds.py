"""Clouds that are looked at in parts and put together again."""

from dataclasses import fields

import torch

from torchrefrac.scene import DenseCloud


def test_the_parts_of_a_cloud_are_the_cloud(draw):
    numbers, counts = draw.uniform(0.01, 1.0, 9), torch.arange(9)
    vectors = draw.normal(9, 3)
    cloud = DenseCloud(vectors, -vectors, vectors.abs().to(torch.uint8), numbers, numbers, counts, counts, numbers, "m")

    again = DenseCloud.joined([cloud[counts[:4]], cloud[counts[:0]], cloud[counts[4:]]])

    for field in fields(cloud):
        one, other = getattr(cloud, field.name), getattr(again, field.name)
        assert one == other if isinstance(one, str) else torch.equal(one, other)
