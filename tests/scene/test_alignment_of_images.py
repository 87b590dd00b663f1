"""Alignments: their consistency, and what is left of them when images or observations go."""

from dataclasses import replace

import pytest
import torch

from tests.files.alignments import assert_same, two_lens_alignment
from torchrefrac.camera import Intrinsics
from torchrefrac.scene import Reconstruction
from torchrefrac.scene.alignment import Alignment, AlignmentError


@pytest.fixture
def alignment(draw):
    return two_lens_alignment(draw)


def small(image, point, points=3, images=3):
    """An alignment with these observations; the first coordinate of a pixel is the number of its row."""
    count = len(image)
    return Alignment(
        names=tuple("abcdef"[:images]),
        lenses=(Intrinsics.create(64, 48, 50.0),),
        lens=torch.zeros(images, dtype=torch.long),
        rotation=torch.eye(3, dtype=torch.float64).repeat(images, 1, 1),
        center=torch.zeros(images, 3, dtype=torch.float64),
        points=torch.arange(3.0 * points, dtype=torch.float64).reshape(points, 3),
        colors=torch.arange(3 * points, dtype=torch.uint8).reshape(points, 3),
        image=torch.tensor(image),
        point=torch.tensor(point),
        pixels=torch.arange(count, dtype=torch.float64)[:, None].repeat(1, 2),
    )


def test_cleaning_keeps_the_first_of_repeated_observations():
    cleaned = small(image=[2, 0, 2, 0, 1], point=[0, 0, 0, 0, 0], points=1).cleaned()

    assert cleaned.image.tolist() == [2, 0, 1]
    assert cleaned.pixels[:, 0].tolist() == [0, 1, 4]


def test_cleaning_drops_points_that_one_image_sees_and_counts_the_others_anew():
    cleaned = small(image=[0, 1, 2, 2, 1, 0], point=[0, 0, 1, 1, 2, 2]).cleaned()

    assert cleaned.points[:, 0].tolist() == [0, 6]
    assert cleaned.colors[:, 0].tolist() == [0, 6]
    assert cleaned.point.tolist() == [0, 0, 1, 1]
    assert cleaned.pixels[:, 0].tolist() == [0, 1, 4, 5]


def test_cleaning_leaves_a_clean_alignment_as_it_is(alignment):
    assert_same(alignment.cleaned(), alignment)


def test_cleaning_drops_points_without_observations():
    assert len(small(image=[0, 1], point=[1, 1]).cleaned().points) == 1


def test_images_that_go_take_their_observations_with_them():
    rest = small(image=[0, 1, 2, 1, 2], point=[0, 0, 0, 1, 1]).of_images(torch.tensor([True, False, True]))

    assert rest.names == ("a", "c")
    assert rest.image.tolist() == [0, 1, 1]
    assert rest.point.tolist() == [0, 0, 1]
    assert rest.pixels[:, 0].tolist() == [0, 2, 4]


def test_a_reconstruction_gives_its_registered_images_and_the_points_they_share(draw):
    reconstruction = Reconstruction(
        names=("a", "b", "c"),
        registered=torch.tensor([True, False, True]),
        rotation=draw.rotations(3),
        center=draw.normal(3, 3),
        intrinsics=Intrinsics.create(64, 48, 50.0),
        index_ratio=1.333,
        length_unit="cm",
        points=draw.normal(2, 3),
        colors=torch.tensor([[1, 2, 3], [4, 5, 6]], dtype=torch.uint8),
        image=torch.tensor([0, 1, 0, 2]),
        point=torch.tensor([0, 0, 1, 1]),
        pixels=draw.normal(4, 2),
    )

    alignment = Alignment.from_reconstruction(reconstruction)

    assert (alignment.names, alignment.length_unit) == (("a", "c"), "cm")
    assert torch.equal(alignment.rotation, reconstruction.rotation[[0, 2]])
    assert torch.equal(alignment.center, reconstruction.center[[0, 2]])
    assert torch.equal(alignment.points, reconstruction.points[1:])
    assert alignment.colors.tolist() == [[4, 5, 6]]
    assert (alignment.image.tolist(), alignment.point.tolist()) == ([0, 1], [0, 0])
    assert torch.equal(alignment.pixels, reconstruction.pixels[2:])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"pixels": torch.zeros(3, 2)}, r"pixels has shape \(3, 2\), but must have \("),
        ({"colors": torch.zeros(1, 3)}, r"colors has shape \(1, 3\), but must have \(40, 3\)"),
        ({"lens": torch.tensor([0, 1, 2, 0, 0])}, "lens runs from 0 to 2, but must lie in 0 to 1"),
        ({"lens": torch.tensor([0, -1, 0, 0, 0])}, "lens runs from -1 to 0, but must lie in 0 to 1"),
        ({"lens": torch.zeros(5)}, "lens has dtype torch.float32, but must be torch.long"),
        (
            {"lenses": (Intrinsics(9, 9, torch.ones(2, 2), torch.ones(2), torch.zeros(5)),) * 2},
            r"lenses\[0\] has batch shape \(2,\)",
        ),
    ],
)
def test_an_inconsistent_alignment_is_refused(alignment, change, message):
    with pytest.raises(AlignmentError, match=message):
        replace(alignment, **change)


def test_observations_out_of_order_are_refused(alignment):
    with pytest.raises(AlignmentError, match="point is not ascending"):
        replace(alignment, point=alignment.point.flip(0))
