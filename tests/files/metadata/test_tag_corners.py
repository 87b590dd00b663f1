"""Corners of dark squares, against where they were drawn."""

import cv2
import numpy as np
import pytest

from torchrefrac.files.metadata.tag_corners import fitted_corners

SIZE, OVER = 400, 9  # px, and parts of a pixel that are drawn
PLACED = np.array(
    [
        [[60.3, 80.7], [331.2, 51.4], [361.8, 330.1], [87.4, 352.6]],
        [[10.4, 8.2], [48.9, 12.1], [45.2, 49.6], [6.3, 44.8]],
    ]
)


def _drawn(square, bend):
    """A dark quadrangle with edges that bulge outwards by `bend` px in the middle."""
    outline = []
    for start, end in zip(square, np.roll(square, -1, axis=0), strict=True):
        share = np.linspace(0.0, 1.0, 400, endpoint=False)[:, None]
        along = end - start
        outwards = np.array((along[1], -along[0])) / np.linalg.norm(along)
        outline.append(start + share * along + 4.0 * share * (1.0 - share) * bend * outwards)
    large = np.full((OVER * SIZE, OVER * SIZE), 220, dtype=np.uint8)
    corners = OVER * (np.concatenate(outline) + 0.5) - 0.5
    cv2.fillPoly(large, [(16.0 * corners).round().astype(np.int32)], 40, shift=4)
    return cv2.GaussianBlur(cv2.resize(large, (SIZE, SIZE), interpolation=cv2.INTER_AREA), (0, 0), 0.8)


@pytest.mark.parametrize("square", PLACED)
@pytest.mark.parametrize("bend", [0.0, 2.0])
def test_corners_are_found_where_edges_meet(square, bend):
    size = np.linalg.norm(square[1] - square[0]) / np.linalg.norm(PLACED[0, 1] - PLACED[0, 0])
    grey = _drawn(square, bend * size**2)  # the same bend of a shorter edge
    noisy = (grey + np.random.default_rng(1).normal(size=grey.shape)).clip(0, 255).astype(np.uint8)
    begun = square + np.array([[0.9, -0.6], [-0.7, 0.8], [0.5, 0.9], [-0.8, -0.5]])

    found = fitted_corners(noisy, begun[None])[0]

    assert np.abs(found - square).max() < (0.1 if bend == 0.0 else 0.25)


def test_several_are_found_at_once():
    grey = np.minimum(*(_drawn(square, 0.0) for square in PLACED[:1].repeat(2, axis=0)))

    together = fitted_corners(grey, PLACED[:1].repeat(2, axis=0))

    assert together[0] == pytest.approx(together[1])
