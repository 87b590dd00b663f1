"""Work in many parts, by processes and by a cluster: everything is done, once, also where a worker is lost."""

import os
import signal
import subprocess
import sys
import time
from functools import partial

import pytest

from tests import worker_jobs as jobs
from torchrefrac.parallel import ExecutorError, ExecutorOptions, Workers

LONG = 60.0  # seconds that jobs seem to take
TWO = ExecutorOptions(workers=2)


def test_every_job_is_done_in_processes_beside_this_one():
    with Workers(TWO) as workers:
        assert dict(workers.each(jobs.squared, range(40), LONG)) == {i: i * i for i in range(40)}
        assert os.getpid() not in {process for _, process in workers.each(jobs.process_of, range(30), LONG)}


def test_few_jobs_and_those_of_one_worker_are_done_here():
    with Workers(TWO) as workers:
        assert {process for _, process in workers.each(jobs.process_of, range(5), 1.0)} == {os.getpid()}
    assert {process for _, process in Workers().each(jobs.process_of, range(50), LONG)} == {os.getpid()}


def test_the_work_of_a_worker_that_is_killed_is_done_by_another(tmp_path):
    with Workers(TWO) as workers:
        found = list(workers.each(partial(jobs.squared_unless_first, tmp_path), range(30), LONG))

    assert sorted(found) == [(i, i * i) for i in range(30)]
    assert (tmp_path / "killed").exists()


def test_workers_that_end_again_and_again_are_an_error_that_says_what_helps(monkeypatch):
    monkeypatch.setattr("torchrefrac.parallel.workers.LOSSES", 1)
    with Workers(TWO) as workers, pytest.raises(ExecutorError, match="workers to fewer"):
        list(workers.each(jobs.killed, range(2), LONG))


def test_work_that_hands_out_its_parts_itself_is_done_once_more_where_a_worker_is_lost(tmp_path):
    def work(executor):
        return list(executor.map(partial(jobs.squared_unless_first, tmp_path), range(5)))

    with Workers(TWO) as workers:
        assert workers.together(work, True) == [0, 1, 4, 9, 16]
        assert workers.together(lambda executor: executor, False) is None
    assert (tmp_path / "killed").exists()


def test_an_error_in_a_job_is_raised_here():
    with Workers(TWO) as workers, pytest.raises(ValueError, match="number"):
        list(workers.each(jobs.refuse, range(30), LONG))


def test_workers_end_with_the_process_that_began_them():
    code = (
        "from tests import worker_jobs as jobs; from torchrefrac.parallel import ExecutorOptions, Workers\n"
        "import sys\n"
        "if __name__ == '__main__':\n"
        "    with Workers(ExecutorOptions(workers=2)) as workers:\n"
        "        print(*{pid for _, pid in workers.each(jobs.process_of, range(30), 60.0)}, flush=True)\n"
        "        list(workers.each(jobs.waits, [60.0] * 30, 60.0))\n"
    )
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        begun = [int(number) for number in process.stdout.readline().split()]
        process.kill()
    deadline = time.monotonic() + 20.0
    while any(map(_lives, begun)) and time.monotonic() < deadline:
        time.sleep(0.1)

    assert begun
    assert not any(map(_lives, begun))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"workers": -1}, "workers is -1"),
        ({"kind": "dask"}, "must be that of a scheduler"),
        ({"address": "tcp://here:1"}, "for executor=dask alone"),
    ],
)
def test_options_that_cannot_be_meant_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        ExecutorOptions(**options)


def test_a_scheduler_that_does_not_answer_is_named(monkeypatch):
    pytest.importorskip("distributed")
    monkeypatch.setattr("torchrefrac.parallel.workers.PATIENCE_S", 0.5)
    options = ExecutorOptions(kind="dask", address="tcp://127.0.0.1:9")

    with Workers(options) as workers, pytest.raises(ExecutorError, match=r"tcp://127\.0\.0\.1:9"):
        list(workers.each(jobs.squared, range(3), LONG))


@pytest.mark.filterwarnings("ignore")  # of a cluster that loses a worker
def test_a_cluster_does_all_also_when_it_loses_a_worker(tmp_path):
    distributed = pytest.importorskip("distributed")
    where = {"n_workers": 2, "threads_per_worker": 1, "dashboard_address": None, "local_directory": str(tmp_path)}
    with (
        distributed.LocalCluster(**where) as cluster,
        Workers(ExecutorOptions(kind="dask", address=cluster.scheduler_address)) as workers,
    ):
        found = list(workers.each(partial(jobs.squared_unless_first, tmp_path), range(20), LONG))
        processes = {process for _, process in workers.each(jobs.process_of, range(6), LONG)}

    assert sorted(found) == [(i, i * i) for i in range(20)]
    assert os.getpid() not in processes


def _lives(process):
    try:
        os.kill(process, signal.SIG_DFL)
    except ProcessLookupError:
        return False
    with open(f"/proc/{process}/stat", encoding="ascii") as file:
        return file.read().rsplit(")", 1)[1].split()[0] != "Z"
