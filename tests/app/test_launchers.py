"""Sweeps in several processes and on a cluster: exit status, records, and what is said."""

import json
import os
import signal
import sys

import pytest
from hydra import compose, initialize_config_dir
from hydra.utils import instantiate
from omegaconf import OmegaConf

from torchrefrac.cli import commands
from torchrefrac.cli.conf import CONF
from torchrefrac.config import OptionError

ONE_FAILS = ("model=refractive", "water.index_ratio=1.33,abc", "features.max_features=300")


@pytest.fixture
def sweep(torchrefrac, half_of_tank, monkeypatch, tmp_path):
    """Runs two jobs, one of which fails, with a launcher; returns how it ended and the records of the jobs."""

    def run(launcher, *arguments):
        monkeypatch.setenv("OMP_NUM_THREADS", "1")
        scene = half_of_tank([0, 3])
        where = (f"hydra/launcher={launcher}", "scene=capture", f"scene.path={scene}", "report=false", "out=runs")
        ended = torchrefrac("-m", *where, *ONE_FAILS, *arguments)
        paths = sorted((tmp_path / "runs").glob("*/metrics.json"))
        return ended, [json.loads(path.read_text()) for path in paths]

    return run


def _needs(package):
    pytest.importorskip(package, reason="needs torchrefrac[sweep]")


@pytest.mark.slow
def test_jobs_of_a_local_queue_end_as_one_after_the_other(sweep, tmp_path):
    _needs("hydra_plugins.hydra_submitit_launcher")

    ended, records = sweep("local_queue")

    assert ended.status == 1
    assert [record["status"] for record in records] == ["complete", "failed"]
    assert "1/2  water.index_ratio=1.33: complete in " in ended.out
    assert "2/2  water.index_ratio=abc: failed: water.index_ratio is 'abc'" in ended.out
    assert list((tmp_path / "runs" / ".submitit").glob("*/*log.out"))


def test_processes_side_by_side_end_as_one_after_the_other(sweep):
    _needs("hydra_plugins.hydra_joblib_launcher")

    ended, records = sweep("processes", "hydra.launcher.n_jobs=2")

    assert ended.status == 1
    assert [record["status"] for record in records] == ["complete", "failed"]
    assert records[1]["reason"] == "water.index_ratio is 'abc', but must be a number"
    assert "1 of 2 jobs failed:" in ended.out


@pytest.mark.slow
def test_a_process_that_dies_takes_no_other_job_with_it(sweep, monkeypatch):
    _needs("hydra_plugins.hydra_joblib_launcher")
    monkeypatch.setattr(commands, "run_options", _die_or_go_on(commands.run_options))

    ended, records = sweep("processes", "hydra.launcher.n_jobs=2")

    assert ended.status == 1
    assert [record["status"] for record in records] == ["complete", "failed"]
    assert "terminated" in records[1]["reason"]
    assert "1 of 2 jobs failed:" in ended.out


def _die_or_go_on(go_on):
    def open_or_die(config):
        if config.water.index_ratio == "abc":
            os.kill(os.getpid(), signal.SIGKILL)
        return go_on(config)

    return open_or_die


def test_slurm_gets_what_the_configuration_says(tmp_path, monkeypatch):
    submitit = pytest.importorskip("submitit", reason="needs torchrefrac[sweep]")
    monkeypatch.setattr(submitit.SlurmExecutor, "affinity", classmethod(lambda cls: 2))
    overrides = ["hydra/launcher=slurm", "hydra.launcher.partition=day", "hydra.launcher.mem_gb=3", f"out={tmp_path}"]
    with initialize_config_dir(str(CONF), version_base="1.3"):
        config = compose("config", overrides=overrides, return_hydra_config=True)
    OmegaConf.update(config, "hydra.job.name", "torchrefrac", force_add=True)

    (tmp_path / "sbatch").write_text('#!/bin/sh\ncp "$1" "${0%sbatch}submitted"\necho Submitted batch job 1\n')
    (tmp_path / "sbatch").chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")

    instantiate(config.hydra.launcher).executor().submit(print)

    text = (tmp_path / "submitted").read_text()
    for line in ("--partition=day", "--cpus-per-task=4", "--mem=3GB", "--time=120", "--job-name=torchrefrac"):
        assert f"#SBATCH {line}\n" in text
    assert "export OMP_NUM_THREADS=$SLURM_CPUS_PER_TASK\n" in text


def test_without_slurm_one_sentence_says_so(torchrefrac, monkeypatch):
    _needs("hydra_plugins.hydra_submitit_launcher")
    monkeypatch.setenv("PATH", "")

    ended = torchrefrac("-m", "hydra/launcher=slurm", "model=none,radial", "out=runs")

    assert ended.status == 1
    assert ended.err.startswith("error: hydra/launcher=slurm needs sbatch and srun, which are not found")


@pytest.mark.parametrize(
    ("launcher", "package"),
    [
        ("processes", "hydra_joblib_launcher"),
        ("slurm", "hydra_submitit_launcher"),
        ("local_queue", "hydra_submitit_launcher"),
    ],
)
def test_without_the_extra_one_sentence_says_what_to_install(torchrefrac, monkeypatch, launcher, package):
    for name in [name for name in sys.modules if name.startswith(f"hydra_plugins.{package}")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setattr(sys, "meta_path", [_Hidden(f"hydra_plugins.{package}"), *sys.meta_path])

    ended = torchrefrac("-m", f"hydra/launcher={launcher}", "model=none,radial", "out=runs")

    assert ended.status == 1
    assert ended.err == f"error: hydra/launcher={launcher} needs more packages: pip install 'torchrefrac[sweep]'\n"


class _Hidden:
    """Makes as if a package were not installed."""

    def __init__(self, package):
        self.package = package

    def find_spec(self, name, path=None, target=None):
        if name.startswith(self.package):
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of what Optuna imports
def test_a_sweeper_that_optimises_gets_the_objective_of_each_run(torchrefrac, half_of_tank, tmp_path):
    _needs("hydra_plugins.hydra_optuna_sweeper")
    where = ("scene=capture", f"scene.path={half_of_tank([0, 3])}", "report=false", "out=runs")
    sweeper = [f"hydra.sweeper.{each}" for each in ("n_trials=2", "n_jobs=1", "sampler.seed=1")]
    options = ("features.max_features=300", "objective=points", "sfm.max_error=interval(1.0,6.0)")

    ended = torchrefrac("-m", "hydra/sweeper=optuna", *sweeper, *where, *options)

    assert ended.status == 0, ended.err
    points = [json.loads(path.read_text())["points"] for path in (tmp_path / "runs").glob("*/metrics.json")]
    best = OmegaConf.load(tmp_path / "runs" / "optimization_results.yaml")
    assert len(points) == 2
    assert best.best_value == min(points)


@pytest.mark.parametrize(
    ("metrics", "name", "wanted"),
    [
        ({"camera_rms_cm": 0.5, "reprojection_median_px": 0.1}, None, 0.5),
        ({"status": "complete", "reprojection_median_px": 0.1}, None, 0.1),
        ({"camera_rms_cm": 0.5, "dense_surface_median_cm": 0.2}, "dense_surface_median_cm", 0.2),
        ({}, None, None),
    ],
)
def test_the_objective_is_an_error(metrics, name, wanted):
    assert commands.objective(metrics, name) == wanted


def test_an_objective_that_the_run_does_not_have_is_named():
    with pytest.raises(OptionError, match=r"objective is 'status', but must be a number .*: points"):
        commands.objective({"status": "complete", "points": 7}, "status")
