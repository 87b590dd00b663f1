"""Textures: the images that are made, and how they are looked up."""

from functools import partial

import cv2
import numpy as np
import pytest
import torch

from torchrefrac.synthetic.patterns import beans, coral, grass, gravel, noise, rock, sand, scales
from torchrefrac.synthetic.prints import checkerboard, label, tiles, wood
from torchrefrac.synthetic.textures import ImageTexture, SideBySide, VertexColours, corner_uv

GROUNDS = {
    "gravel": gravel,
    "beans": beans,
    "grass": grass,
    "sand": sand,
    "rock": partial(rock, tone=(150.0, 118.0, 104.0)),
    "coral": coral,
    "scales": partial(scales, ground=(214.0, 128.0, 46.0), stripe=(236.0, 226.0, 208.0)),
    "label": partial(label, words="COFFEE"),
    "checkerboard": partial(checkerboard, columns=8, rows=8),
    "tiles": tiles,
}
ALL = {**GROUNDS, "wood": wood}


@pytest.fixture
def image():
    return np.random.default_rng(1).integers(0, 256, (5, 7, 3), dtype=np.uint8)


@pytest.mark.parametrize("make", GROUNDS.values(), ids=GROUNDS)
def test_a_ground_has_contrast_and_thousands_of_keypoints(make):
    picture = make((640, 640), 3)

    grey = cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY)
    keypoints = cv2.SIFT_create().detect(grey)  # pyright: ignore[reportAttributeAccessIssue]
    assert 25.0 <= float(grey.std()) <= 62.0
    assert len(keypoints) > 1500 * grey.size / 1024**2


@pytest.mark.parametrize("make", ALL.values(), ids=ALL)
def test_a_texture_is_its_seeds_alone(make):
    first, again, other = make((96, 128), 5), make((96, 128), 5), make((96, 128), 6)

    assert first.shape == (96, 128, 3)
    assert first.dtype == np.uint8
    assert np.array_equal(first, again)
    assert np.abs(first.astype(float) - other).mean() > 3.0


@pytest.mark.parametrize("make", [gravel, sand], ids=("gravel", "sand"))
def test_a_ground_does_not_repeat(make):
    grey = make((512, 512), 1).mean(axis=-1)
    grey -= grey.mean()

    spectrum = np.abs(np.fft.rfft2(grey, (1024, 1024))) ** 2
    likeness = np.fft.irfft2(spectrum)
    likeness /= likeness[0, 0]
    far = np.ones_like(likeness, dtype=bool)
    for rows in (slice(0, 150), slice(-150, None)):
        for columns in (slice(0, 150), slice(-150, None)):
            far[rows, columns] = False
    assert float(likeness[far].max()) < 0.15


def test_noise_has_unit_deviation_and_detail_at_every_scale():
    field = noise((256, 256), np.random.default_rng(2), decay=1.0)

    assert abs(float(field.mean())) < 1e-5
    assert float(field.std()) == pytest.approx(1.0, abs=1e-5)
    for step in (2, 8, 32, 128):
        assert float(np.abs(field[:, step:] - field[:, :-step]).mean()) > 0.2


def test_centres_of_texels_have_the_texels_colours(image):
    column, row = np.meshgrid((np.arange(7) + 0.5) / 7, 1.0 - (np.arange(5) + 0.5) / 5)
    uv = torch.from_numpy(np.stack((column, row), axis=-1).reshape(-1, 2))

    for repeat in (False, True):
        colours = ImageTexture(image, repeat=repeat)(uv)

        assert colours.dtype == torch.float32
        assert np.allclose(colours.numpy(), image.reshape(-1, 3), atol=2e-3)


def test_between_texels_the_colour_is_bilinear(image):
    generator = torch.Generator().manual_seed(0)
    uv = 0.1 + 0.8 * torch.rand(200, 2, dtype=torch.float64, generator=generator)

    colours = ImageTexture(image)(uv).numpy()

    x, y = uv[:, 0].numpy() * 7 - 0.5, (1.0 - uv[:, 1].numpy()) * 5 - 0.5
    i, j = np.floor(x).astype(int), np.floor(y).astype(int)
    a, b = (x - i)[:, None], (y - j)[:, None]
    texel = image.astype(float)
    right, below = np.minimum(i + 1, 6), np.minimum(j + 1, 4)
    upper = (1 - a) * texel[j, i] + a * texel[j, right]
    lower = (1 - a) * texel[below, i] + a * texel[below, right]
    assert np.allclose(colours, (1 - b) * upper + b * lower, atol=2e-3)


def test_beyond_its_border_an_image_continues_or_starts_again(image):
    uv = torch.tensor(((0.3, 0.6), (1.3, -1.4), (-2.7, 3.6)), dtype=torch.float64)

    again = ImageTexture(image, repeat=True)(uv)
    clamped = ImageTexture(image)(uv)

    assert torch.allclose(again, again[:1].expand(3, 3), atol=1e-2)
    assert np.allclose(clamped[1].numpy(), image[4, 6])
    assert np.allclose(clamped[2].numpy(), image[0, 0])


def test_a_repeated_image_has_no_seam(image):
    uv = torch.tensor(((1.0 - 1e-6, 0.5), (1e-6, 0.5)), dtype=torch.float64)

    colours = ImageTexture(image, repeat=True)(uv)

    assert torch.allclose(colours[0], colours[1], atol=1e-2)
    assert np.allclose(colours[0].numpy(), 0.5 * (image[2, 0].astype(float) + image[2, 6]), atol=1e-2)


@pytest.mark.parametrize("wrong", [np.zeros((4, 4), np.uint8), np.zeros((4, 4, 3)), np.zeros((0, 4, 3), np.uint8)])
def test_what_is_no_image_is_refused(wrong):
    with pytest.raises(ValueError, match=r"must be uint8 of shape \(H, W, 3\)"):
        ImageTexture(wrong)


def test_textures_side_by_side_each_have_their_own_unit_of_u():
    def flat(*colour):
        return ImageTexture(np.array(colour, dtype=np.uint8).reshape(1, 1, 3))

    texture = SideBySide([flat(1, 0, 0), flat(0, 2, 0), flat(0, 0, 3)])

    colours = texture(torch.tensor([[0.0, 0.5], [1.0, 0.5], [1.4, 0.5], [2.9, 0.1]], dtype=torch.float64))

    assert colours.tolist() == [[1, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3]]


def test_colours_of_vertices_are_interpolated_over_their_face(draw):
    colours = draw.uniform(0.0, 255.0, 40, 3, 3).float()
    weights = draw.uniform(0.0, 1.0, 500, 3)
    weights = weights / weights.sum(dim=-1, keepdim=True)
    face = torch.arange(500) % 40
    uv = (weights[..., None] * corner_uv(40).reshape(40, 3, 2)[face]).sum(dim=1)

    found = VertexColours(colours)(uv)

    expected = (weights[..., None].float() * colours[face]).sum(dim=1)
    assert torch.allclose(found, expected, atol=1e-3)
