"""SIFT keypoints on images of blobs whose places are known."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from torchrefrac.features import SiftOptions, extract_sift
from torchrefrac.features.sift import _largest, _strongest

SIZE, SPACING = 640, 40


@pytest.fixture
def write_image(tmp_path):
    """`write_image(array)`: the path of a lossless image file, grey (h, w) or BGR (h, w, 3)."""

    def write(array):
        path = tmp_path / "image.png"
        assert cv2.imwrite(str(path), array)
        return path

    return write


@pytest.fixture
def blobs(draw):
    """A grey image of Gaussian blobs, bright and dark, and their centres (n, 2): x, y with the first pixel's at 0.5."""
    grid = torch.arange(SPACING, SIZE - SPACING + 1, SPACING, dtype=torch.float64)
    centers = torch.cartesian_prod(grid, grid)
    centers = centers + draw.uniform(-3.0, 3.0, *centers.shape)
    sigma, sign = draw.uniform(2.0, 6.0, len(centers)), draw.normal(len(centers)).sign()
    pixel = torch.arange(SIZE, dtype=torch.float64) + 0.5
    across, down = (torch.exp(-0.5 * ((pixel - centers[:, i, None]) / sigma[:, None]) ** 2) for i in range(2))
    image = 128.0 + 100.0 * torch.einsum("n,ny,nx->yx", sign, down, across)
    return image.round().to(torch.uint8).numpy(), centers


def test_a_keypoint_lies_within_a_tenth_of_a_pixel_of_its_blob(write_image, blobs):
    image, centers = blobs

    offset = _offsets(extract_sift(write_image(image), SiftOptions()), centers)

    assert len(offset) >= 0.8 * len(centers)
    assert offset.norm(dim=-1).median() < 0.05
    assert (offset.norm(dim=-1) < 0.1).double().mean() > 0.95


def test_keypoints_are_not_shifted_as_a_whole(write_image, blobs):
    """OpenCV's coarse upscaling would shift them by a quarter of a pixel, its pixel origin by a half."""
    image, centers = blobs

    offset = _offsets(extract_sift(write_image(image), SiftOptions()), centers)

    assert offset.mean(dim=0).abs().amax() < 0.03


def test_descriptors_are_rootsift_of_length_one(write_image, blobs):
    features = extract_sift(write_image(blobs[0]), SiftOptions())

    assert features.descriptors.shape == (len(features), 128)
    assert features.unit().dtype == torch.float32
    assert (features.unit() >= 0.0).all()
    torch.testing.assert_close(features.unit().norm(dim=-1), torch.ones(len(features)), rtol=0.0, atol=1e-5)


def test_squared_descriptors_are_proportional_to_opencvs(write_image, blobs):
    image, _ = blobs

    features = extract_sift(write_image(image), SiftOptions())

    keypoints, plain = cv2.SIFT.create(enable_precise_upscale=True).detectAndCompute(image, None)
    expected = torch.from_numpy(plain / plain.sum(axis=1, keepdims=True))
    assert len(features) == len(keypoints)
    apart = torch.cdist(features.unit().double().square(), expected.double())
    assert float(apart.amin(dim=1).max()) < 1e-4
    assert float(apart.amin(dim=0).max()) < 1e-4


def test_colours_are_red_green_blue_at_the_keypoint(write_image, blobs):
    image, _ = blobs
    bgr = np.stack((image // 4, image // 2, image), axis=-1)

    features = extract_sift(write_image(bgr), SiftOptions())

    assert len(features) > 0
    column, row = features.pixels.floor().long().T
    assert torch.equal(features.colors, torch.from_numpy(bgr[..., ::-1].copy())[row, column])


def _keypoints(*sizes_and_contrasts):
    """Of three layers to an octave, as OpenCV finds them."""
    return [cv2.KeyPoint(0.0, 0.0, size, 0.0, contrast / 3.0) for size, contrast in sizes_and_contrasts]


def test_of_more_than_are_wanted_the_strongest_are_taken_that_come_up_to_the_threshold():
    many = _keypoints((1.8, 0.5), (1.8, 0.3), (3.6, 0.045), (3.6, 0.021))

    def contrasts(count, enough=0.0):
        chosen = _strongest(many, SiftOptions(max_features=count), enough)
        return [round(3.0 * each.response, 3) for each in chosen]

    assert contrasts(2) == [0.5, 0.3]
    assert contrasts(4) == [0.5, 0.3, 0.045]
    assert contrasts(4, enough=4.0) == [0.5, 0.3, 0.045, 0.021]


def test_or_large_ones_are_taken_however_faint_but_no_larger_ones_than_serve():
    many = _keypoints((1.8, 0.5), (3.6, 0.045), (3.6, 0.021), (7.2, 0.011), (60.0, 0.011), (9.0, 0.01))

    chosen = _largest(many, SiftOptions(max_features=5))

    assert [(round(each.size, 1), round(3.0 * each.response, 3)) for each in chosen] == [
        (7.2, 0.011), (9.0, 0.01), (3.6, 0.045), (3.6, 0.021), (1.8, 0.5),
    ]  # fmt: skip


def test_large_keypoints_are_taken_of_images_that_have_many_pixels_for_each():
    options = SiftOptions(max_features=1000, max_pixels=1e6)

    assert options.for_images(500_000).choice == "strongest"
    assert options.for_images(700_000).choice == "largest"
    assert replace(options, max_features=2000).for_images(12e6).choice == "strongest"
    assert replace(options, choice="strongest").for_images(700_000).choice == "strongest"


def test_a_place_has_two_orientations_at_most_where_large_ones_are_taken():
    several = [cv2.KeyPoint(5.0, 7.0, 8.0, angle, 0.1) for angle in (10.0, 90.0, 200.0)]
    several.append(cv2.KeyPoint(5.0, 7.5, 8.0, 30.0, 0.05))

    chosen = _largest(several, SiftOptions())

    assert [each.angle for each in chosen] == [10.0, 90.0, 30.0]
    assert _largest([], SiftOptions()) == []


def test_images_of_many_pixels_are_reduced_and_keypoints_placed_in_those_of_the_file(write_image, blobs):
    image, centers = blobs
    path, fewer = write_image(image), SiftOptions(max_pixels=SIZE**2 / 3.0)

    features = extract_sift(path, fewer)

    offset = _offsets(features, centers)
    assert len(offset) >= 0.6 * len(centers)
    assert offset.norm(dim=-1).median() < 0.1
    assert offset.mean(dim=0).abs().amax() < 0.05
    assert float(features.noise.min()) == pytest.approx(3.0**0.5, rel=0.01)
    used = torch.ones(SIZE, SIZE, dtype=torch.bool)
    used[:, SIZE // 2 :] = False
    assert float(extract_sift(path, fewer, used).pixels[:, 0].max()) < SIZE // 2


def test_a_blank_image_has_no_features(write_image):
    features = extract_sift(write_image(np.full((120, 160), 127, dtype=np.uint8)), SiftOptions())

    assert len(features) == 0
    assert features.pixels.shape == (0, 2)
    assert features.descriptors.shape == (0, 128)
    assert features.colors.shape == (0, 3)


def test_keypoints_in_pixels_that_may_not_be_used_are_dropped_and_those_near_them(write_image, blobs):
    image, centers = blobs
    used = torch.ones(SIZE, SIZE, dtype=torch.bool)
    used[SIZE // 2 :] = False
    path = write_image(image)

    features = extract_sift(path, SiftOptions(), used)

    everywhere = extract_sift(path, SiftOptions())
    assert float(features.pixels[:, 1].max()) < SIZE // 2 - 3.0
    far = everywhere.pixels[:, 1] < SIZE // 2 - 40.0
    assert len(features) < len(everywhere)
    assert torch.cdist(everywhere.pixels[far], features.pixels).amin(dim=1).max() < 0.01
    offset = _offsets(features, centers)
    assert offset.norm(dim=-1).median() < 0.05
    torch.testing.assert_close(features.unit().norm(dim=-1), torch.ones(len(features)), rtol=0.0, atol=1e-5)


def test_what_may_not_be_used_takes_no_room_among_the_strongest(write_image, blobs):
    """A caption is sharper than all else."""
    image = blobs[0].copy()
    image[SIZE // 2 :] = 128 + (image[SIZE // 2 :].astype(int) - 128) // 4
    image[: SIZE // 2] = np.kron(np.indices((40, 80)).sum(axis=0) % 2 * 255, np.ones((8, 8))).astype(np.uint8)
    used = torch.zeros(SIZE, SIZE, dtype=torch.bool)
    used[SIZE // 2 :] = True

    features = extract_sift(write_image(image), SiftOptions(max_features=50), used)

    assert len(features) == 50
    assert float(features.pixels[:, 1].min()) > SIZE // 2


def test_the_descriptors_of_what_may_be_used_are_those_of_the_whole_image(write_image, blobs):
    used = torch.ones(SIZE, SIZE, dtype=torch.bool)
    used[:, :40] = False
    path = write_image(blobs[0])

    some, every = extract_sift(path, SiftOptions(), used), extract_sift(path, SiftOptions())

    same = torch.cdist(some.pixels, every.pixels) < 1e-6  # several, of different orientations
    closeness = (some.unit() @ every.unit().T - 2.0 * ~same).amax(dim=1)
    assert float(closeness.min()) > 0.9999


def test_nothing_is_found_where_nothing_may_be_used(write_image, blobs):
    features = extract_sift(write_image(blobs[0]), SiftOptions(), torch.zeros(SIZE, SIZE, dtype=torch.bool))

    assert (len(features), features.descriptors.shape, features.colors.shape) == (0, (0, 128), (0, 3))


def test_an_image_of_hardly_any_contrast_is_searched_for_fainter_keypoints(write_image, blobs):
    image, centers = blobs
    faint = (128.0 + (image - 128.0) * 0.08).round().astype(np.uint8)

    features = extract_sift(write_image(faint), SiftOptions())

    offset = _offsets(features, centers)
    assert len(offset) >= 0.7 * len(centers)
    assert offset.norm(dim=-1).median() < 0.1


def test_an_image_with_enough_keypoints_is_not(write_image, blobs):
    """What is found is what OpenCV finds with the threshold that is asked for."""
    image = blobs[0]

    features = extract_sift(write_image(image), SiftOptions(contrast_threshold=0.05))

    sift = cv2.SIFT.create(nfeatures=8192, contrastThreshold=0.05, enable_precise_upscale=True)
    assert len(features) == len(sift.detect(image, None))


def _offsets(features, centers):
    """From each blob to its nearest keypoint (k, 2), where one lies within two pixels."""
    distance = torch.cdist(centers, features.pixels)
    nearest = distance.argmin(dim=1)
    found = distance.amin(dim=1) < 2.0
    return (features.pixels[nearest] - centers)[found]
