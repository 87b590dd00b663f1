"""Figures that draw whatever they get, and progress that reads well on and off a terminal."""

import io
import re

import cv2
import pytest
import torch

from torchrefrac.figures.side_views import SideView, draw_side_views
from torchrefrac.files.library import embedded_scene
from torchrefrac.files.truth import load_truth
from torchrefrac.record import terminal
from torchrefrac.record.recorders import Recorders
from torchrefrac.record.tensorboard import TensorBoardRecorder
from torchrefrac.record.terminal import TerminalRecorder
from torchrefrac.recorder import SilentRecorder


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
    both.cloud("b", torch.zeros(1, 3), torch.zeros(1, 3, dtype=torch.uint8), 0)
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


def test_a_long_stage_says_off_a_terminal_that_it_lives(monkeypatch):
    monkeypatch.setattr(terminal, "ALIVE_SECONDS", 0.0)
    stream = io.StringIO()

    with TerminalRecorder(stream).meter(2000, "densifying", "cell") as advance:
        advance(860, "90 patches/s")
        advance(1140, "")

    first, last = stream.getvalue().splitlines()
    assert first == "densifying   43 % after 0 s, 90 patches/s"
    assert last.startswith("densifying   2000 cells in ")


def test_a_short_stage_does_not(monkeypatch):
    stream = io.StringIO()

    list(TerminalRecorder(stream).track(range(9), 9, "matching", "pair"))

    assert stream.getvalue().count("\n") == 1


@pytest.mark.parametrize("stream", [io.StringIO(), Terminal()], ids=["file", "terminal"])
def test_work_without_a_unit_shows_no_count(stream):
    with TerminalRecorder(stream).meter(150, "adjusting", "") as advance:
        advance(150, "cost 2.5")

    assert "150" not in stream.getvalue()
    assert "adjusting" in stream.getvalue()
    assert "cost 2.5" in stream.getvalue()


def test_a_bar_below_another_one_disappears_when_it_ends():
    stream = Terminal()
    recorder = TerminalRecorder(stream)

    for _ in recorder.track(range(2), 2, "registering", "image"):
        list(recorder.track(range(2), 2, "adjusting", "round"))

    shown = on_screen(stream.getvalue())
    assert [line.split()[0] for line in shown] == ["registering"]
    assert "2/2 images" in shown[0]


def test_a_note_beside_a_bar_has_a_line_of_its_own():
    stream = Terminal()
    recorder = TerminalRecorder(stream)

    for i in recorder.track(range(2), 2, "registering", "image"):
        if i:
            recorder.note("a line")

    shown = on_screen(stream.getvalue())
    assert shown[0] == "a line"
    assert "2/2 images" in shown[1]


def test_what_is_said_after_a_run_that_broke_off_has_a_line_of_its_own():
    stream = Terminal()

    def run():
        with TerminalRecorder(stream) as recorder:
            for i in recorder.track(range(4), 4, "registering", "image"):
                if i == 2:
                    raise ValueError("broken")

    with pytest.raises(ValueError, match="broken"):
        run()
    stream.write("error: broken\n")

    shown = on_screen(stream.getvalue())
    assert "2/4 images" in shown[0]
    assert shown[1] == "error: broken"


def on_screen(written):
    """The lines that a terminal shows which has been sent this."""
    lines, row, column = [""], 0, 0
    for part in re.findall(r"\x1b\[A|\r|\n|[^\x1b\r\n]+", written):
        if part == "\x1b[A":
            row -= 1
        elif part == "\r":
            column = 0
        elif part == "\n":
            row, column = row + 1, 0
            lines += [""] * (row + 1 - len(lines))
        else:
            lines[row] = lines[row].ljust(column)[:column] + part + lines[row][column + len(part) :]
            column += len(part)
    return [line.rstrip() for line in lines if line.strip()]


@pytest.mark.parametrize("name", ["histogram", "picture", "cloud", "scalar", "detail"])
def test_several_recorders_pass_on_what_they_are_told(name):
    told = {
        "histogram": ("residuals/px", torch.ones(2), 0),
        "picture": ("matches/1", torch.zeros(1, 1, 3, dtype=torch.uint8), 0),
        "cloud": ("sparse", torch.zeros(1, 3), torch.zeros(1, 3, dtype=torch.uint8), 0),
        "scalar": ("adjustment/cost", 1.0, 0),
        "detail": ("cost 2 to 1",),
    }[name]
    heard = []

    class Hearing(SilentRecorder):
        wants_pictures = True

        def __getattribute__(self, asked):
            return (lambda *what: heard.append(what)) if asked == name else super().__getattribute__(asked)

    both = Recorders(SilentRecorder(), Hearing(), Hearing())
    getattr(both, name)(*told)

    assert heard == [told, told]
    assert both.wants_pictures
    assert not Recorders(SilentRecorder(), SilentRecorder()).wants_pictures


def test_tensorboard_takes_lumps_in_silence(tmp_path):
    with TensorBoardRecorder(tmp_path) as board, board.meter(3, "densifying", "cell") as advance:
        advance(3, "fast")

    assert len(list(tmp_path.iterdir())) == 1
