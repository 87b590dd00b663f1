"""Sweeps as a person uses them: they go on, are resumed, keep what is complete, and say in a sentence what is wrong."""

import errno
import json
import os
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from hydra_plugins.torchrefrac_sweeper.messages import one_sentence
from torchrefrac.cli import commands
from torchrefrac.files.run import RunRecord
from torchrefrac.sweeps.folder import SweepFolder
from torchrefrac.sweeps.jobs import Job, write_sweep


@dataclass
class QuickRuns:
    """Takes the place of a reconstruction: a word in metrics.json, and what `plan` raises for a job's label."""

    plan: dict[str, BaseException] = field(default_factory=dict)
    done: list[str] = field(default_factory=list)

    def __call__(self, capture, options, recorder, folder, about, truth):
        self.done.append(folder.name)
        for word, error in self.plan.items():
            if word in folder.name:
                raise error
        measured = {"images": 2, "registered_images": 2, "points": 9, "reprojection_median_px": 0.1}
        told = {"model": options.model.name, "capture": str(capture.folder), "gravity": "measured"}
        metrics = {"status": "complete", "stages": [], "seconds_total": 0.1} | told | measured | about
        RunRecord.of(folder, metrics).write()
        return metrics


@pytest.fixture
def runs(monkeypatch):
    quick = QuickRuns()
    monkeypatch.setattr(commands, "run", quick)
    monkeypatch.setattr("torchrefrac.sweeps.summary.draw_sweep", lambda *_: False)
    return quick


@pytest.fixture
def sweep(torchrefrac, small_tank):
    """Runs a sweep over the small tank into the folder runs."""
    return lambda *arguments: torchrefrac("-m", "scene=capture", f"scene.path={small_tank}", "out=runs", *arguments)


TWELVE = ("water.index_ratio=1,1.1,1.2,1.3,1.4,abc", "model=none,refractive")


@pytest.fixture
def statuses(tmp_path):
    """The status of each job, by its folder."""

    def read():
        paths = sorted((tmp_path / "runs").glob("*/metrics.json"))
        return {path.parent.name: json.loads(path.read_text())["status"] for path in paths}

    return read


def test_of_twelve_jobs_two_fail_and_the_same_command_again_runs_these_two(sweep, runs, statuses, metrics, tmp_path):
    ended = sweep(*TWELVE)

    assert ended.status == 1
    found = statuses()
    assert list(found)[:3] == ["00_none", "01_refractive", "02_none"]
    assert [name for name, status in found.items() if status == "failed"] == ["10_none", "11_refractive"]
    assert list(found.values()).count("complete") == 10
    reason = "water.index_ratio is 'abc', but must be a number"
    assert metrics(tmp_path / "runs" / "10_none")["reason"] == reason
    assert " ".join(ended.out.split()).count(reason) == 2
    assert " 3/12  water.index_ratio=1.1 model=none" in ended.err
    before = list(runs.done)

    again = sweep(*TWELVE)

    assert "10 of 12 jobs were finished before and are kept" in again.out
    assert "12/12  water.index_ratio=abc model=refractive" in again.err
    assert " 1/12" not in again.err
    assert runs.done == before  # the two fail before they run
    assert again.status == 1
    assert list(statuses().values()).count("complete") == 10


def test_what_to_type_to_resume_is_said_and_does_resume(sweep, torchrefrac, runs, statuses, tmp_path):
    runs.plan["0_none"] = ValueError("a bug")
    ended = sweep("model=none,radial")
    line = next(line for line in ended.out.splitlines() if line.startswith("  torchrefrac "))
    runs.plan.clear()
    runs.done.clear()

    again = torchrefrac(*line.split()[1:])

    assert again.status == 0
    assert runs.done == ["0_none"]
    assert statuses() == {"0_none": "complete", "1_radial": "complete"}


def test_a_job_that_cannot_be_composed_says_why_and_the_others_run(torchrefrac, runs, metrics, tmp_path):
    ended = torchrefrac("-m", "scene=tank_small,nonsense", "model=none,radial", "out=runs")

    assert ended.status == 1
    assert runs.done == ["0_none", "1_radial"]
    found = metrics(tmp_path / "runs" / "2_none")
    assert found["status"] == "failed"
    assert found["reason"].startswith("scene is 'nonsense', but must be one of aquarium, cans, ")
    assert found["overrides"] == {"scene": "nonsense", "model": "none"}
    assert (found["model"], found["scene"]) == ("none", "nonsense")
    assert "3/4  scene=nonsense model=none: failed: scene is 'nonsense'" in ended.err


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["model=none,radial", "bogus=1"], "bogus is not an option; known here are cache, colmap, compare_land,"),
        (["model=none,radial", "scene=pond"], "scene is 'pond', but must be one of aquarium, cans,"),
        (["model=none,radial", "water.index_ratio={"], "'water.index_ratio={' is not understood"),
        (["model=none,radial", "out=a,b"], "out=a,b has several values, but a sweep has one out"),
        (["model=none,radial", "nothing"], "'nothing' is not understood (missing EQUAL at '<EOF>')"),
        (["sfm.max_eror=1,2"], "sfm.max_eror is not an option; known here are bundle,"),
    ],
)
def test_what_concerns_all_jobs_is_one_sentence_and_leaves_nothing(torchrefrac, runs, tmp_path, arguments, sentence):
    ended = torchrefrac("-m", *arguments)

    assert ended.status == 1
    assert ended.err.startswith(f"error: {sentence}")
    assert len(ended.err.splitlines()) == 1
    assert not list(tmp_path.glob("*/*/metrics.json"))


def test_a_bug_in_one_job_does_not_stop_the_others_and_is_in_its_log(sweep, runs, statuses, metrics, tmp_path):
    runs.plan["0_none"] = ZeroDivisionError("division\nby zero")

    ended = sweep("model=none,radial")

    assert ended.status == 1
    assert statuses() == {"0_none": "failed", "1_radial": "complete"}
    assert metrics(tmp_path / "runs" / "0_none")["reason"].startswith("division by zero; ")
    assert "ZeroDivisionError" in (tmp_path / "runs" / "0_none" / "run.log").read_text()
    assert "Traceback" not in ended.err


def test_a_job_without_memory_is_said_to_lack_it():
    assert one_sentence(MemoryError()) == "there is not enough memory (MemoryError)"


def test_a_full_disk_is_named_with_a_remedy(sweep, runs, metrics, statuses, tmp_path):
    runs.plan["0_none"] = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    ended = sweep("model=none,radial")

    assert statuses() == {"0_none": "failed", "1_radial": "complete"}
    assert "is full; make room there, or give a folder elsewhere as out=DIR" in ended.out.replace("\n  ", " ")
    assert str(tmp_path / "runs" / "0_none") in metrics(tmp_path / "runs" / "0_none")["reason"]


def test_a_job_that_can_leave_no_word_is_still_told_of(sweep, runs, statuses, tmp_path):
    (tmp_path / "runs").mkdir()
    (tmp_path / "runs" / "0_none").write_text("a file where a folder should be")

    ended = sweep("model=none,radial")

    assert ended.status == 1
    assert statuses() == {"1_radial": "complete"}
    told = " ".join(ended.out.split())
    assert "- 0_none (model=none): runs/0_none cannot be written to (" in told


def test_an_interrupt_stops_the_sweep_and_the_next_goes_on_from_there(sweep, runs, statuses, tmp_path):
    runs.plan["1_radial"] = KeyboardInterrupt()
    ended = sweep("model=none,radial,refractive")
    assert ended.status == 130
    assert statuses() == {"0_none": "complete"}
    assert "2 of 3 jobs did not come to an end" in ended.out
    assert (tmp_path / "runs" / "summary.csv").is_file()
    runs.plan.clear()
    runs.done.clear()

    again = sweep("model=none,radial,refractive")

    assert again.status == 0
    assert "1 of 3 jobs was finished before and is kept" in again.out
    assert runs.done == ["1_radial", "2_refractive"]


def test_a_folder_of_another_sweep_is_left_alone(sweep, runs, statuses):
    sweep("model=none,radial")

    ended = sweep("model=radial,refractive")

    assert ended.status == 1
    assert ended.err == (
        "error: runs holds another sweep (2 jobs, one of them model=none); give another folder as out=DIR\n"
    )
    assert list(statuses()) == ["0_none", "1_radial"]


def test_a_folder_of_a_single_run_is_left_alone(sweep, runs, tmp_path):
    RunRecord.of(tmp_path / "runs", {"status": "complete", "stages": []}).write()

    ended = sweep("model=none,radial")

    assert ended.err.startswith("error: runs holds results that are not of this sweep")
    assert not runs.done


def test_the_order_in_which_a_sweep_is_typed_makes_no_other_sweep_of_it(sweep, runs):
    sweep("model=none,radial", "seed=1")
    runs.done.clear()

    ended = sweep("seed=1", "model=none,radial")

    assert ended.status == 0
    assert not runs.done


def test_a_default_that_has_changed_since_is_refused_and_named(sweep, runs, tmp_path):
    sweep("model=none,radial")
    path = tmp_path / "runs" / "1_radial" / ".hydra" / "config.yaml"
    path.write_text(path.read_text().replace("seed: 0", "seed: 7"))
    runs.done.clear()

    ended = sweep("model=none,radial")

    assert ended.status == 1
    assert "runs/1_radial was made with other settings (seed was 7 and is 0 now); delete it" in ended.err
    assert not runs.done


def test_a_folder_that_cannot_be_written_to_is_one_sentence(sweep, runs, tmp_path):
    (tmp_path / "runs").write_text("a file")

    ended = sweep("model=none,radial")

    assert ended.status == 1
    assert ended.err.startswith("error: runs cannot be written to (File exists)")
    assert len(ended.err.splitlines()) == 1


@pytest.mark.skipif(os.geteuid() == 0, reason="the superuser may write everywhere")
def test_a_folder_without_permission_is_one_sentence(sweep, runs, tmp_path):
    (tmp_path / "runs").mkdir(mode=0o500)

    ended = sweep("model=none,radial")

    assert ended.status == 1
    assert ended.err.startswith("error: runs cannot be written to (Permission denied)")


def test_a_sweep_over_scenes_lies_in_one_folder(torchrefrac, runs, small_tank, tmp_path):
    ended = torchrefrac("-m", "scene=tank_small,capture", f"+scene.path={small_tank}")

    assert ended.status == 0
    (folder,) = (tmp_path / "outputs").iterdir()
    assert folder.name.endswith("_scenes")
    assert {"0_refractive", "1_refractive", "sweep.json"} <= {path.name for path in folder.iterdir()}


def test_metrics_say_scene_and_overrides(sweep, runs, small_tank, metrics, tmp_path):
    sweep("model=none,radial", "seed=3")

    found = metrics(Path(tmp_path) / "runs" / "1_radial")

    assert found["scene"] == "part_of_tank"
    assert found["overrides"] == {
        "scene": "capture", "scene.path": str(small_tank), "model": "radial", "seed": "3",
    }  # fmt: skip


def test_the_record_of_an_earlier_attempt_stays_until_the_job_leaves_another(tmp_path):
    job, run = Job("0_none", ("model=none",), "model=none"), tmp_path / "0_none"
    write_sweep([job], tmp_path)
    RunRecord.of(run, {"status": "interrupted", "stages": ["sparse"]}).write()
    folder = SweepFolder(tmp_path, (job,))

    assert folder.make_ready(job)
    assert RunRecord.read(run).stages == ("sparse",)
    assert not folder.has_record(job)
    RunRecord.of(run, {"status": "failed", "stages": []}).write()
    assert folder.has_record(job)
