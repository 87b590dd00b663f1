"""Tables of tracks, and of the points that came of them."""

import re

import pytest
import torch

from torchrefrac.files.track_table import read_track_table, write_track_points
from torchrefrac.refinement import PointEstimate
from torchrefrac.scene import CaptureError

VIEWS = ("left.jpg", "right.jpg", "top/a.png")


def test_points_come_in_the_order_of_the_file_and_keep_their_names(tmp_path):
    path = tmp_path / "fish.csv"
    path.write_text(
        "frame,id,view,x,y,likelihood\n7,nemo,left.jpg,10,20.5,0.9\n7,2,right,1e1,3,1\n\n7,nemo,top/a,4,5,1\n"
    )

    table = read_track_table(path, VIEWS, 0.5)

    assert table.names == (("7", "nemo"), ("7", "2"))
    seen = table.observations
    assert (seen.view.tolist(), seen.point.tolist()) == ([0, 1, 2], [0, 1, 0])
    assert seen.pixels.tolist() == [[10.5, 21.0], [10.5, 3.5], [4.5, 5.5]]


@pytest.mark.parametrize("separator", [";", "\t"])
def test_columns_may_stand_in_any_order_behind_a_byte_order_mark(tmp_path, separator):
    path = tmp_path / "fish.csv"
    rows = [("View", "Y", "X", "ID", "Frame"), ("left", "2", "1", "a b", "0")]
    path.write_text("\r\n".join(map(separator.join, rows)) + "\r\n", encoding="utf-8-sig")

    table = read_track_table(path, VIEWS, 0.0)

    assert table.names == (("0", "a b"),)
    assert table.observations.pixels.tolist() == [[1.0, 2.0]]


def test_a_name_without_ending_that_two_images_have_is_unknown(tmp_path):
    path = tmp_path / "fish.csv"
    path.write_text("frame,id,view,x,y\n1,1,a,2,3\n")

    with pytest.raises(CaptureError, match=r"line 2: view is 'a', but the run has placed a\.jpg, a\.png$"):
        read_track_table(path, ("a.jpg", "a.png"), 0.0)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("", " has no column frame; its first line must name frame, id, view, x, y"),
        ("frame,id,view,x\n", " has no column y; its first line must name frame, id, view, x, y"),
        ("frame,id,view,x,y\n", " has no line but the first; it must be a CSV file of tracks, with the columns "
         "frame, id, view, x, y"),
        ("frame,id,view,x,y\n1,1,left,2,3\n1,1,rigth,2,3\n", ": line 3: view is 'rigth', but the run has placed "
         "left.jpg, right.jpg, top/a.png"),
        ("frame,id,view,x,y\n1,1,left,2,\n", ": line 2: y is '', but must be a number"),
        ("frame,id,view,x,y\n1,1,left,nan,3\n", ": line 2: x is 'nan', but must be a number"),
        ("frame,id,view,x,y\n\n1,1,left,one,3\n", ": line 3: x is 'one', but must be a number"),
        ("frame,id,view,x,y\n1,1,left,2\n", ": line 2 has 4 columns, but the first line names 5"),
        ("frame,id,view,x,y\n1,a,left,2,3\n1,a,left.jpg,2,3\n", ": line 3 has a in frame 1 of left.jpg again; leave "
         "one of them"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_said_with_its_line(tmp_path, text, sentence):
    path = tmp_path / "fish.csv"
    path.write_text(text)

    with pytest.raises(CaptureError, match=f"^{re.escape(str(path) + sentence)}$"):
        read_track_table(path, VIEWS, 0.0)


def test_files_that_are_missing_or_no_text_are_refused(tmp_path):
    with pytest.raises(CaptureError, match="does not exist, but must be a CSV file of tracks"):
        read_track_table(tmp_path / "none.csv", VIEWS, 0.0)
    (tmp_path / "binary.csv").write_bytes(b"frame,id,view,x,y\n\xff\xfe\x00")
    with pytest.raises(CaptureError, match="cannot be read as a CSV file of tracks"):
        read_track_table(tmp_path / "binary.csv", VIEWS, 0.0)


def test_wanted_points_are_written_with_what_they_rest_on(tmp_path):
    points = torch.tensor([[1.0, 2.0, -3.0], [0.1, 0.2, -0.3], [4.0, 5.0, -6.25]], dtype=torch.float64)
    covariance = torch.diag(torch.tensor([0.01, 0.04, 0.25], dtype=torch.float64)).expand(3, 3, 3)
    one, yes = torch.ones(3, dtype=torch.float64), torch.ones(3, dtype=torch.bool)
    estimate = PointEstimate(points, covariance, 0.25 * one, one, yes, torch.tensor([2, 0, 3]), yes)

    names = (("1", "a"), ("1", "b"), ("2", "a, b"))
    write_track_points(tmp_path / "points.csv", names, estimate, torch.tensor([0, 0, 1]), torch.tensor([1, 0, 1]) > 0)

    assert (tmp_path / "points.csv").read_text().splitlines() == [
        "frame,id,X,Y,Z,sigma_X,sigma_Y,sigma_Z,views,set_aside,error_px",
        "1,a,1,2,-3,0.1,0.2,0.5,2,0,0.25",
        '2,"a, b",4,5,-6.25,0.1,0.2,0.5,3,1,0.25',
    ]
    assert [path.name for path in tmp_path.iterdir()] == ["points.csv"]
