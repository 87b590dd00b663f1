"""Lists of pairs of images, and what is wrong with them."""

import pytest

from torchrefrac.files.match_list import read_match_list
from torchrefrac.scene import CaptureError

NAMES = ("a.jpg", "b.jpg", "day 2/c 1.jpg", "d.jpg")


@pytest.fixture
def read(tmp_path):
    """`read(text)`: the pairs of a file with that text."""

    def of(text):
        path = tmp_path / "pairs.txt"
        path.write_text(text, encoding="utf-8")
        return read_match_list(path, NAMES)

    return of


def test_pairs_are_read_in_either_order_and_names_may_have_blanks(read):
    found = read("# pairs\nb.jpg a.jpg\n\nday 2/c 1.jpg   a.jpg\na.jpg b.jpg\nd.jpg day 2/c 1.jpg\n")

    assert found.triu().nonzero().tolist() == [[0, 1], [0, 2], [2, 3]]
    assert bool((found == found.T).all())


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("a.jpg b.jpg\na.jpg e.jpg\n", "line 2 names e.jpg, which is no image here: a.jpg, b.jpg, day 2/c 1.jpg, ..."),
        ("x.jpg b.jpg\n", "line 1 names x.jpg, which is no image here"),
        ("a.jpg\n", "line 1 has one name, but must have those of two images"),
        ("a.jpg a.jpg\n", "line 1 pairs a.jpg with itself; name two images"),
        ("# nothing\n", "lists no pair, but must have the names of two images a line"),
        ("", "is empty, but must be a list of the names of two images a line"),
    ],
)
def test_what_is_wrong_is_one_sentence_with_the_line(read, text, sentence):
    with pytest.raises(CaptureError, match=sentence):
        read(text)
