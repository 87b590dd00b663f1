"""Tracks joined from matches."""

from dataclasses import replace

import pytest
import torch

from torchrefrac.features import Features, PairMatches, build_tracks


def _features(*counts):
    """For each image so many keypoints; the k-th of image i lies at (k, i) and has the colour (i, k, 0)."""
    return [
        Features(
            torch.tensor([[k, i] for k in range(count)], dtype=torch.float64).reshape(-1, 2),
            torch.zeros(count, 128),
            torch.tensor([[i, k, 0] for k in range(count)], dtype=torch.uint8).reshape(-1, 3),
            2.0 + torch.arange(count, dtype=torch.float64),
        )
        for i, count in enumerate(counts)
    ]


def _pair(first, second, *matches):
    return PairMatches(first, second, torch.tensor(matches, dtype=torch.long).reshape(-1, 2))


def _as_sets(built):
    """Each track as the sorted list of (image, keypoint)."""
    seen, colors = built
    found = [[] for _ in colors]
    for view, point, pixel in zip(seen.view.tolist(), seen.point.tolist(), seen.pixels.tolist(), strict=True):
        found[point].append((view, int(pixel[0])))
    return sorted(found)


def test_matches_are_joined_through_third_images():
    pairs = [_pair(0, 1, (0, 2), (1, 0)), _pair(1, 2, (2, 1))]

    tracks = build_tracks(_features(3, 3, 3), pairs)

    assert _as_sets(tracks) == [[(0, 0), (1, 2), (2, 1)], [(0, 1), (1, 0)]]


def test_a_match_that_closes_a_circle_adds_nothing():
    pairs = [_pair(0, 1, (0, 0)), _pair(1, 2, (0, 0)), _pair(0, 2, (0, 0)), _pair(2, 0, (0, 0))]

    assert _as_sets(build_tracks(_features(1, 1, 1), pairs)) == [[(0, 0), (1, 0), (2, 0)]]


def test_observations_are_sorted_by_track_and_image_and_carry_their_pixels():
    pairs = [_pair(2, 0, (0, 1), (1, 0)), _pair(1, 2, (2, 1))]

    seen, _ = build_tracks(_features(3, 3, 3), pairs)

    order = list(zip(seen.point.tolist(), seen.view.tolist(), strict=True))
    assert order == sorted(order)
    assert torch.equal(seen.pixels[:, 1].long(), seen.view)


def test_the_colour_of_a_track_is_the_mean_of_its_keypoints():
    pairs = [_pair(2, 0, (0, 1), (1, 0)), _pair(1, 2, (2, 1))]

    seen, colors = build_tracks(_features(3, 3, 3), pairs)

    assert colors.dtype == torch.uint8
    for point, color in enumerate(colors.tolist()):
        mine = seen[seen.point == point]
        assert color == [round(float(mine.view.double().mean())), round(float(mine.pixels[:, 0].mean())), 0]


def test_a_track_with_two_keypoints_of_one_image_is_dropped_whole():
    pairs = [_pair(0, 1, (0, 0), (2, 2)), _pair(1, 2, (0, 0)), _pair(0, 2, (1, 0))]

    assert _as_sets(build_tracks(_features(3, 3, 3), pairs)) == [[(0, 2), (1, 2)]]


def test_keypoints_at_one_position_count_as_one():
    features = _features(3, 3, 3)
    features[1].pixels[2] = features[1].pixels[1]  # a second orientation of keypoint 1

    tracks = build_tracks(features, [_pair(0, 1, (0, 1)), _pair(1, 2, (2, 0))])

    assert _as_sets(tracks) == [[(0, 0), (1, 1), (2, 0)]]


def test_keypoints_at_one_position_of_different_images_stay_apart():
    features = _features(2, 2)
    features[1].pixels[:] = features[0].pixels

    seen, _ = build_tracks(features, [_pair(0, 1, (0, 1))])

    assert seen.view.tolist() == [0, 1]


@pytest.mark.parametrize(("min_length", "expected"), [(2, 2), (3, 1), (4, 0)])
def test_tracks_of_too_few_images_are_dropped(min_length, expected):
    pairs = [_pair(0, 1, (0, 0), (1, 1)), _pair(1, 2, (0, 0))]

    seen, colors = build_tracks(_features(2, 2, 2), pairs, min_length)

    assert len(colors) == expected
    assert sorted(set(seen.point.tolist())) == list(range(expected))


@pytest.mark.parametrize("pairs", [[], [_pair(0, 1)]], ids=["no pairs", "a pair without matches"])
@pytest.mark.parametrize("counts", [(3, 3), (0, 0), (3, 0)])
def test_without_matches_there_are_no_tracks(pairs, counts):
    seen, colors = build_tracks(_features(*counts), pairs)

    assert (seen.view.shape, seen.point.shape) == ((0,), (0,))
    assert (seen.pixels.shape, colors.shape) == ((0, 2), (0, 3))


def test_an_image_without_features_takes_no_part():
    tracks = build_tracks(_features(2, 0, 2), [_pair(0, 1), _pair(0, 2, (0, 1))])

    assert _as_sets(tracks) == [[(0, 0), (2, 1)]]


def test_observations_have_the_noise_of_their_keypoints():
    features = [replace(each, noise=torch.tensor((1.0, 2.0, 5.0)).double()) for each in _features(3, 3)]

    seen, _ = build_tracks(features, [_pair(0, 1, (0, 2), (2, 1))])

    assert seen.noise.tolist() == [1.0, 5.0, 5.0, 2.0]
