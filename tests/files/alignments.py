"""An alignment of two lenses with tracks of several lengths, and what it means for two alignments to be the same."""

import torch

from torchrefrac.camera import Intrinsics
from torchrefrac.scene.alignment import Alignment

PLAIN = Intrinsics.create(640, 480, (500.0, 501.0), (321.5, 239.25))
BENT = Intrinsics.create(800, 600, (700.0, 699.0), (400.5, 301.0), (0.1, -0.02, 1e-3, -2e-3, 0.003))
EXACT = ("lens", "points", "colors", "image", "point", "pixels")


def two_lens_alignment(draw, images=5, points=40):
    """Each point is seen by 2 to `images` images, in an order of their own."""
    tracks = [torch.randperm(images, generator=draw.generator)[: 2 + i % (images - 1)] for i in range(points)]
    image = torch.cat(tracks)
    return Alignment(
        names=tuple(f"left/{i}.jpg" for i in range(images)),
        lenses=(PLAIN, BENT),
        lens=torch.arange(images) % 2,
        rotation=draw.rotations(images),
        center=10.0 * draw.normal(images, 3),
        points=draw.normal(points, 3),
        colors=torch.randint(256, (points, 3), dtype=torch.uint8, generator=draw.generator),
        image=image,
        point=torch.arange(points).repeat_interleave(torch.tensor([len(track) for track in tracks])),
        pixels=draw.uniform(0.0, 480.0, len(image), 2),
    )


def assert_same_lens(lens, wanted):
    assert (lens.width, lens.height) == (wanted.width, wanted.height)
    for name in ("focal", "principal_point", "distortion"):
        assert torch.equal(getattr(lens, name), getattr(wanted, name)), name


def assert_same(alignment, wanted, poses_exact=True):
    """To the last bit; poses up to the rounding of a quaternion unless poses_exact."""
    assert alignment.names == wanted.names
    assert alignment.length_unit == wanted.length_unit
    assert len(alignment.lenses) == len(wanted.lenses)
    for lens, other in zip(alignment.lenses, wanted.lenses, strict=True):
        assert_same_lens(lens, other)
    for name in (*EXACT, "rotation", "center") if poses_exact else EXACT:
        assert torch.equal(getattr(alignment, name), getattr(wanted, name)), name
    torch.testing.assert_close(alignment.rotation, wanted.rotation, rtol=0.0, atol=4e-15)
    torch.testing.assert_close(alignment.center, wanted.center, rtol=4e-15, atol=4e-14)
