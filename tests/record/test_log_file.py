"""run.log tells what happened, whatever happened."""

import re

import pytest

import torchrefrac
from torchrefrac.record import log_file
from torchrefrac.record.log_file import LogFile
from torchrefrac.record.recorders import run_recorders

STAMP = re.compile(r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d ")


def lines(path):
    """Without their times."""
    stamped = path.read_text().splitlines()
    assert all(STAMP.match(line) for line in stamped)
    return [line[20:] for line in stamped]


@pytest.fixture
def path(tmp_path):
    return tmp_path / "run" / "run.log"


def test_a_log_begins_with_versions_and_what_the_run_is(path):
    with LogFile(path, about={"command": "torchrefrac scene=tank_small"}):
        pass

    told = lines(path)
    assert [line.split(":")[0] for line in told[:6]] == [
        "torchrefrac", "python", "torch", "device", "threads", "command",
    ]  # fmt: skip
    assert told[0] == f"torchrefrac: {torchrefrac.__version__}"
    assert told[5] == "command: torchrefrac scene=tank_small"


def test_stages_notes_and_details_have_a_line_each(path):
    with LogFile(path) as log:
        list(log.track("ab", 3, "registering", "image"))
        with log.meter(2000, "densifying", "cell") as advance:
            advance(2000, "90 patches/s")
        with log.meter(1, "assessing", "") as advance:
            advance(1, "")
        log.note("index ratio 1")
        log.detail("cost 9 to 1")
        log.scalar("adjustment/cost", 1.0, 0)

    told = [re.sub(r"\d+\.\d s", "T", line) for line in lines(path)[5:]]
    assert told == [
        "registering begins: 3 images",
        "registering ended: 2/3 images in T",
        "densifying begins: 2000 cells",
        "densifying ended: 2000/2000 cells in T, 90 patches/s",
        "assessing begins",
        "assessing ended after T",
        "index ratio 1",
        "cost 9 to 1",
        "complete after T",
    ]


def test_every_line_is_on_disk_at_once(path):
    with LogFile(path) as log:
        log.note("a line")

        assert lines(path)[-1] == "a line"


def failing(path, error, **options):
    with LogFile(path, **options) as log, log.meter(5, "matching", "pair") as advance:
        advance(2, "")
        raise error


def test_an_expected_error_is_a_sentence(path):
    with pytest.raises(ValueError, match="no two"):
        failing(path, ValueError("no two\nimages"), expected=(ValueError,))

    told = lines(path)[-3:]
    assert told[0].startswith("matching broke off: 2/5 pairs in ")
    assert told[1] == "error: no two images"
    assert told[2].startswith("failed after ")


def test_an_unexpected_error_has_its_traceback(path):
    with pytest.raises(KeyError):
        failing(path, KeyError("lens"), expected=(ValueError,))

    told = lines(path)
    assert "error: 'lens'" in told
    assert "  Traceback (most recent call last):" in told
    assert told[-2].endswith("KeyError: 'lens'")
    assert told[-1].startswith("failed after ")


def test_an_interrupted_run_says_so_without_a_traceback(path):
    with pytest.raises(KeyboardInterrupt):
        failing(path, KeyboardInterrupt())

    told = lines(path)
    assert told[-1].startswith("interrupted after ")
    assert not any("Traceback" in line for line in told)


def test_a_log_is_begun_anew_or_gone_on_with(path):
    for options, runs in (({}, 1), ({"append": True}, 2), ({}, 1)):
        with LogFile(path, **options):
            pass

        assert sum(line.startswith("complete") for line in lines(path)) == runs


class FullDisk:
    """A file that takes so many writes."""

    def __init__(self, left):
        self.left, self.closed = left, False

    def write(self, text):
        if not self.left:
            raise OSError(28, "No space left on device")
        self.left -= 1

    def close(self):
        self.closed = True


def test_a_full_disk_is_told_once_and_does_not_hide_why_a_run_failed(path, monkeypatch, capsys):
    disk = FullDisk(left=6)
    monkeypatch.setattr(log_file.Path, "open", lambda *_, **__: disk)

    with pytest.raises(ValueError, match="no two images"):
        failing(path, ValueError("no two images"))

    assert capsys.readouterr().err == (
        f"warning: {path} cannot be written (No space left on device); the run goes on without\n"
    )
    assert disk.closed


def test_a_log_that_cannot_be_opened_does_not_stop_a_run(tmp_path, capsys):
    (tmp_path / "run.log").mkdir()

    with LogFile(tmp_path / "run.log") as log:
        log.note("a line")

    assert "run.log cannot be written (Is a directory)" in capsys.readouterr().err


@pytest.mark.parametrize("quiet", [False, True])
def test_a_quiet_run_says_nothing_and_logs_the_same(tmp_path, capsys, quiet):
    with run_recorders(tmp_path, quiet) as recorder:
        list(recorder.track("ab", 2, "matching", "pair"))
        recorder.note("a line")
        wants = recorder.wants_pictures

    shown = capsys.readouterr()
    assert shown.out == ""
    assert ("matching" in shown.err, "a line" in shown.err) == (not quiet, not quiet)
    assert any(line.startswith("matching ended: 2/2 pairs") for line in lines(tmp_path / "run.log"))
    assert len(list((tmp_path / "events").iterdir())) == 1
    assert wants


@pytest.mark.parametrize(("unfinished", "append", "runs"), [(False, False, 1), (False, True, 2), (True, False, 2)])
def test_runs_that_go_on_keep_log_and_events_and_others_begin_anew(tmp_path, unfinished, append, runs):
    with run_recorders(tmp_path, True):
        pass
    if unfinished:
        (tmp_path / "dense" / "parts").mkdir(parents=True)

    with run_recorders(tmp_path, True, append=append):
        pass

    assert sum(line.startswith("complete") for line in lines(tmp_path / "run.log")) == runs
    assert len(list((tmp_path / "events").iterdir())) == runs


def test_an_error_ends_all_recorders_and_goes_through(tmp_path):
    def run():
        with run_recorders(tmp_path, True, expected=(ValueError,)) as recorder:
            recorder.scalar("a", 1.0, 0)
            raise ValueError("no two images")

    with pytest.raises(ValueError, match="no two images"):
        run()

    assert lines(tmp_path / "run.log")[-2] == "error: no two images"
