"""Figures that draw whatever they get, and progress that reads well on and off a terminal."""

import io

import cv2
import pytest
import torch

from torchrefrac.recorder import SilentRecorder
from torchrefrac.report.figures import SideView, draw_side_views
from torchrefrac.report.recorders import Recorders
from torchrefrac.report.tensorboard import TensorBoardRecorder
from torchrefrac.report.terminal import TerminalRecorder
from torchrefrac.scene import load_truth
from torchrefrac.scene.library import embedded_scene


class Terminal(io.StringIO):
    def isatty(self):
        return True


@pytest.mark.parametrize("with_truth", [True, False])
@pytest.mark.parametrize("count", [0, 1, 500])
def test_a_side_view_is_drawn_for_any_number_of_points(tmp_path, draw, with_truth, count):
    points = draw.uniform(-100.0, 0.0, count, 3)
    view = SideView("Refraction", f"{count} points", points, draw.uniform(10.0, 20.0, 2, 3), "cm", True)
    truth = load_truth(embedded_scene("tank_small")) if with_truth else None
    draw_side_views([view, view], truth, tmp_path / "view.png")
    image = cv2.imread(str(tmp_path / "view.png"))
    assert image.shape[1] > image.shape[0] > 300
    assert image.std() > 5


def test_progress_off_a_terminal_is_one_line_a_stage():
    stream = io.StringIO()
    assert list(TerminalRecorder(stream).track("abc", 3, "matching", "pair")) == ["a", "b", "c"]
    assert stream.getvalue().startswith("matching     3/3 pairs in ")
    assert stream.getvalue().count("\n") == 1


def test_progress_on_a_terminal_fits_100_columns():
    stream = Terminal()
    list(TerminalRecorder(stream).track(range(7), 7, "matching", "pair"))
    last = stream.getvalue().split("\r")[-1].rstrip("\n")
    assert "7/7 pairs" in last
    assert len(last) <= 100


def test_stages_that_end_early_say_how_far_they_got():
    stream = io.StringIO()
    list(TerminalRecorder(stream).track(range(2), 6, "registering", "image"))
    assert "2/6 images" in stream.getvalue()


def test_several_recorders_pass_each_item_once():
    stream = io.StringIO()
    both = Recorders(TerminalRecorder(stream), SilentRecorder())
    both.scalar("a", 1.0, 0)
    both.cloud("b", torch.zeros(1, 3), torch.zeros(1, 3), 0)
    both.note("a line")
    assert list(both.track([1, 2], 2, "stage", "item")) == [1, 2]
    assert "a line" in stream.getvalue()


def test_work_that_comes_in_lumps_is_one_line_off_a_terminal():
    stream = io.StringIO()

    with TerminalRecorder(stream).meter(2000, "densifying", "cell") as advance:
        advance(1500, "90 patches/s")
        advance(500, "")

    assert stream.getvalue().startswith("densifying   2000 cells in ")
    assert stream.getvalue().endswith(" s, 90 patches/s\n")
    assert stream.getvalue().count("\n") == 1


def test_work_that_breaks_off_does_not_say_that_it_is_done():
    stream = io.StringIO()

    def work():
        with TerminalRecorder(stream).meter(2000, "densifying", "cell") as advance:
            advance(1500, "90 patches/s")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        work()

    assert stream.getvalue() == ""


def test_lumps_on_a_terminal_fit_100_columns():
    stream = Terminal()

    with TerminalRecorder(stream).meter(2000, "densifying", "cell") as advance:
        advance(1500, "90 patches/s")
        advance(500, "")

    last = stream.getvalue().split("\r")[-1].rstrip("\n")
    assert "100 %, 90 patches/s" in last
    assert len(last) <= 100


def test_several_recorders_hear_of_each_lump():
    first, second = io.StringIO(), io.StringIO()
    both = Recorders(TerminalRecorder(first), SilentRecorder(), TerminalRecorder(second))

    with both.meter(3, "densifying", "cell") as advance:
        advance(3, "fast")

    assert [stream.getvalue().endswith(", fast\n") for stream in (first, second)] == [True, True]


def test_tensorboard_takes_lumps_in_silence(tmp_path):
    with TensorBoardRecorder(tmp_path) as board, board.meter(3, "densifying", "cell") as advance:
        advance(3, "fast")

    assert len(list(tmp_path.iterdir())) == 1
