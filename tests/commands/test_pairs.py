"""Which pairs are matched, by what is stated and by what photographs look like."""

import re
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import pytest
import torch

from torchrefrac.camera import Intrinsics
from torchrefrac.commands.pairs import FEW, choose_pairs, pairs_left_out
from torchrefrac.config import OptionError
from torchrefrac.features import Features, MatchOptions
from torchrefrac.scene import Cameras, Capture, CaptureError, Interfaces

SPACING = 8.0


@pytest.fixture
def line(draw):
    """`line(count)`: photographs straight down along a line, which overlap with two neighbours on either side, and
    their features: descriptors of places on the ground."""

    def make(count):
        x = SPACING * torch.arange(count, dtype=torch.float64)
        intrinsics = Intrinsics.create(
            width=400, height=200, focal=(200.0, 200.0), principal_point=(200.0, 100.0), distortion=(0.0,) * 5
        )
        nothing = torch.zeros_like(x)
        capture = Capture(
            folder=Path("nowhere"),
            names=tuple(f"DJI_{i:04d}.jpg" for i in range(count)),
            paths=tuple(Path(f"DJI_{i:04d}.jpg") for i in range(count)),
            cameras=Cameras.of([intrinsics]),
            interfaces=Interfaces.level(1.33),
            down_in_cam=torch.tensor([0.0, 0.0, 1.0]).double().expand(count, 3),
            down_sigma=torch.full_like(x, 0.01),
            height=nothing,
            has_height=nothing > 0.0,
            length_unit="m",
            position=torch.stack((x, nothing, nothing + 10.0), dim=-1),
            position_sigma=torch.full((count, 3), 0.02).double(),
            heading=nothing,
            has_heading=nothing == 0.0,
        )
        places = draw.uniform(0.0, 1.0, 40 * count + 100, 128).float() ** 3
        places = torch.nn.functional.normalize(places, dim=-1)
        descriptors = [places[40 * i : 40 * i + 100] for i in range(count)]
        zero = torch.zeros(100, 2).double(), torch.zeros(100, 3, dtype=torch.uint8), torch.ones(100).double()
        return capture, [Features(zero[0], one, zero[1], zero[2]) for one in descriptors]

    return make


def _apart(chosen):
    return (chosen.pairs[:, 1] - chosen.pairs[:, 0]).tolist()


def _without_positions(capture):
    return replace(capture, position_sigma=torch.full_like(capture.position_sigma, torch.inf))


def test_all_pairs_of_few_photographs_are_matched_in_the_order_of_combinations(line):
    chosen = choose_pairs(*line(FEW - 1), MatchOptions(), 0)

    assert [tuple(pair) for pair in chosen.pairs.tolist()] == list(combinations(range(FEW - 1), 2))
    assert chosen.metrics == {"pairs_matched": 741, "pairs_possible": 741, "pairs_by": "exhaustive"}


def test_positions_give_the_pairs_that_overlap_and_no_others(line):
    chosen = choose_pairs(*line(60), MatchOptions(pairs="positions"), 0)

    assert set(_apart(chosen)) == {1, 2, 3}  # the third if the ground lies deeper
    assert len(chosen.pairs) == 59 + 58 + 57
    assert chosen.by == "positions"


def test_no_more_partners_than_are_wanted_are_those_that_overlap_most(line):
    chosen = choose_pairs(*line(60), MatchOptions(pairs="positions", per_image=2), 0)

    assert set(_apart(chosen)) <= {1, 2}
    assert _apart(chosen).count(1) == 59


def test_photographs_without_a_position_have_partners_by_their_looks(line):
    capture, features = line(60)
    capture.position_sigma[20] = torch.inf

    chosen = choose_pairs(capture, features, MatchOptions(pairs="positions", per_image=4), 0)

    pairs = {tuple(pair) for pair in chosen.pairs.tolist()}
    assert {(18, 20), (19, 20), (20, 21), (20, 22)} <= pairs


def test_many_photographs_are_paired_by_positions_and_looks_or_by_looks_and_order(line):
    capture, features = line(60)
    unordered = replace(_without_positions(capture), names=tuple(f"{i**3}.jpg" for i in range(60)))

    by = {
        "positions and retrieval": choose_pairs(capture, features, MatchOptions(), 0),
        "retrieval and sequence": choose_pairs(_without_positions(capture), features, MatchOptions(), 0),
        "retrieval": choose_pairs(unordered, features, MatchOptions(per_image=6), 0),
    }

    for name, chosen in by.items():
        pairs = {tuple(pair) for pair in chosen.pairs.tolist()}
        assert chosen.by == name
        assert {(i, i + 1) for i in range(59)} <= pairs
        assert len(pairs) < chosen.possible
        assert chosen.pairs.tolist() == sorted(chosen.pairs.tolist())


def test_a_sequence_has_neighbours_and_a_few_that_look_alike(line):
    capture, features = line(60)
    closing = [*features[:-1], features[0]]  # the last photograph is of where the first was taken

    chosen = choose_pairs(
        _without_positions(capture), closing, MatchOptions(pairs="sequence", window=3, per_image=3), 0
    )

    pairs = {tuple(pair) for pair in chosen.pairs.tolist()}
    assert {(i, i + step) for step in (1, 2, 3, 4, 8, 16, 32) for i in range(60 - step)} <= pairs
    assert (0, 59) in pairs


def test_photographs_hang_together_across_a_gap(line):
    capture, features = line(60)
    capture.position[30:, 0] += 500.0

    chosen = choose_pairs(capture, features, MatchOptions(pairs="positions"), 0)

    across = [pair for pair in chosen.pairs.tolist() if pair[0] < 30 <= pair[1]]
    assert across == [[29, 30]]


def test_a_file_lists_them(line, tmp_path):
    path = tmp_path / "pairs.txt"
    path.write_text("DJI_0003.jpg DJI_0001.jpg\nDJI_0000.jpg DJI_0002.jpg\n", encoding="utf-8")

    chosen = choose_pairs(*line(5), MatchOptions(pairs=str(path)), 0)

    assert chosen.pairs.tolist() == [[0, 2], [1, 3]]
    assert chosen.metrics == {"pairs_matched": 2, "pairs_possible": 10, "pairs_by": "file"}
    path.write_text("DJI_0003.jpg DJI_0009.jpg\n", encoding="utf-8")
    with pytest.raises(CaptureError, match=r"line 1 names DJI_0009\.jpg, which is no image here"):
        choose_pairs(*line(5), MatchOptions(pairs=str(path)), 0)
    wanted = "matching.pairs is 'nearest', but must be auto, exhaustive, positions, sequence, retrieval, or a file"
    with pytest.raises(OptionError, match=re.escape(wanted)):
        choose_pairs(*line(5), MatchOptions(pairs="nearest"), 0)


def test_positions_that_are_not_stated_are_refused(line):
    capture, features = line(5)

    with pytest.raises(OptionError, match=r"matching\.pairs is positions, but no photograph has one; try retrieval"):
        choose_pairs(_without_positions(capture), features, MatchOptions(pairs="positions"), 0)


def test_photographs_that_are_left_out_are_paired_with_all_that_they_were_not_tried_with():
    tried = torch.tensor([[0, 1], [1, 2], [0, 3], [1, 4], [0, 2]])
    registered = torch.tensor([True, True, True, False, False])

    assert pairs_left_out(tried, registered).tolist() == [[0, 4], [1, 3], [2, 3], [2, 4], [3, 4]]
    assert pairs_left_out(tried[:2], registered).tolist() == [[0, 3], [0, 4]]
    assert len(pairs_left_out(tried, torch.ones(5, dtype=torch.bool))) == 0
